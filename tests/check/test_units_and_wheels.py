"""Units and wheels that cannot be right are named by the check; sound recordings give nothing."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS
from lanes import slow, slow_cases

from omnibench.check.misreadings import search
from omnibench.check.source import recorded as recorded_of
from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.finding import Finding
from omnibench.robot.kinematics import Array
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

RPM = 2 * math.pi / 60
Change = Callable[[Trajectory], Trajectory]


def commands(*turn_rates: float, speed: float = 0.2, directions: Sequence[float] = range(0, 360, 30)) -> dict[str, Any]:
    return {"speeds": [speed], "directions_deg": list(directions), "turn_rates": list(turn_rates)}


FLOWER = commands(-0.35, 0.0, 0.35)
MOTIONS = {
    "flower": FLOWER,
    "straight runs only": commands(0.0),
    "forward only": commands(0.0, directions=[0]),
    "one turning run": commands(0.35, directions=[90]),
    "turns on the spot only": commands(-0.35, 0.35, speed=0.0),
    "fast turns on the spot": commands(-2.0, 2.0, speed=0.0),
}


@cache
def recorded(motion: str = "flower", robot: str = "apr02", sparse: bool = False) -> Dataset:
    """One simulated run of every command, off the design and noisy; with the first and last pose only if sparse."""
    content = yaml.safe_load((CONFIGS / f"{robot}.yaml").read_text())
    (dataset,) = content["datasets"].values()
    settings = {**dataset["simulate"], "repetitions": 1, "validation": None}
    if robot == "apr02":
        settings["commands"] = MOTIONS[motion]
    simulated = simulate_dataset(validate(FlowerConfig, settings, robot)).dataset
    if not sparse:
        return simulated
    ends = [replace(t, pose_times=t.pose_times[[0, -1]], poses=t.poses[[0, -1]]) for t in simulated.trajectories[::2]]
    return replace(simulated, trajectories=tuple(ends))


def warnings_of(dataset: Dataset, *changes: Change) -> str:
    runs = list(dataset.trajectories)
    for change in changes:
        runs = [change(run) for run in runs]
    return "; ".join(sorted(mistake.what for mistake in mistakes_of(dataset, runs)))


def mistakes_of(dataset: Dataset, runs: Sequence[Trajectory]) -> tuple[Finding, ...]:
    changed = make_dataset("changed", dataset.robot, dataset.sample_period, runs)
    return search(recorded_of(changed)).mistakes


def rates(change: Callable[[Array], Array]) -> Change:
    return lambda run: replace(run, rates=change(run.rates))


def headings(change: Callable[[Array], Array]) -> Change:
    return lambda run: replace(run, poses=np.column_stack([run.poses[:, :2], change(run.poses[:, 2])]))


def positions(factor: float) -> Change:
    return lambda run: replace(run, poses=run.poses * [factor, factor, 1.0])


def shifted(x: float, y: float, heading: float) -> Change:
    """The same run somewhere else on the floor."""

    def change(run: Trajectory) -> Trajectory:
        path = (run.poses[:, 0] + 1j * run.poses[:, 1]) * np.exp(1j * heading) + x + 1j * y
        return replace(run, poses=np.column_stack([path.real, path.imag, run.poses[:, 2] + heading]))

    return change


IN_RPM = rates(lambda values: values / RPM)
IN_DEGREES_WITHIN_180 = headings(lambda values: (np.degrees(values) + 180) % 360 - 180)
IN_MM, IN_CM = positions(1000.0), positions(100.0)

_HEADING = "theta looks like degrees; it must be rad"
MISTAKES = {
    "rpm": (IN_RPM, "wheel rates look like rpm; omega_* must be rad/s"),
    "degrees per second": (rates(np.degrees), "wheel rates look like deg/s; omega_* must be rad/s"),
    "degrees": (headings(np.degrees), _HEADING),
    "degrees within 180": (IN_DEGREES_WITHIN_180, _HEADING),
    "degrees within 360": (headings(lambda values: np.degrees(values) % 360), _HEADING),
    "mm": (IN_MM, "positions look like mm; x and y must be m"),
    "cm": (IN_CM, "positions look like cm; x and y must be m"),
}
ANGLES = ("degrees", "degrees within 180", "degrees within 360")
RATES_AND_POSITIONS = ("rpm", "degrees per second", "mm", "cm")
OTHER_MISTAKES = ("degrees per second", "degrees", "degrees within 360", "cm")


@pytest.mark.parametrize("robot", ["apr02", *slow("mecanum")])
@pytest.mark.parametrize("mistake", ["rpm", "degrees within 180", "mm", *slow(*OTHER_MISTAKES)])
def test_a_wrong_unit_is_named_by_first_and_last_poses_alone(mistake: str, robot: str) -> None:
    change, warning = MISTAKES[mistake]
    assert warnings_of(recorded(robot=robot, sparse=True), change) == warning


@pytest.mark.parametrize(
    ("motion", "mistake"),
    [
        *(("flower", mistake) for mistake in MISTAKES),
        *(("forward only", mistake) for mistake in RATES_AND_POSITIONS),
        ("turns on the spot only", "degrees"),
        *slow_cases(
            *(("straight runs only", mistake) for mistake in RATES_AND_POSITIONS),
            *(("turns on the spot only", mistake) for mistake in ANGLES[1:]),
            *(("one turning run", mistake) for mistake in MISTAKES),
        ),
    ],
)
def test_a_wrong_unit_is_named_in_simpler_motions_and_wherever_the_robot_started(motion: str, mistake: str) -> None:
    change, warning = MISTAKES[mistake]
    assert warnings_of(recorded(motion), change) == warning
    assert warnings_of(recorded(motion), shifted(-40.0, 25.0, 2.5), change) == warning


@pytest.mark.parametrize(
    ("changes", "units"),
    [
        ((IN_MM, IN_DEGREES_WITHIN_180), ("degrees", "mm")),
        ((IN_RPM, IN_DEGREES_WITHIN_180), ("rpm", "degrees")),
        ((IN_RPM, IN_MM, IN_DEGREES_WITHIN_180), ("rpm", "degrees", "mm")),  # Table 1 of the article
    ],
)
def test_several_wrong_units_are_all_named(changes: tuple[Change, ...], units: tuple[str, ...]) -> None:
    assert warnings_of(recorded(), *changes) == "; ".join(sorted(MISTAKES[unit][1] for unit in units))


def rearranged(order: Sequence[int], signs: Sequence[int]) -> Change:
    return rates(lambda values: values[:, list(order)] * signs)


ARRANGEMENTS = [*product(permutations(range(3)), product((1, -1), repeat=3))][1:]  # all but the right one
EXCHANGES = [(order, signs) for order, signs in ARRANGEMENTS if max(signs) > 0]


@pytest.mark.parametrize(("order", "signs"), [*EXCHANGES[::4], *slow_cases(*sorted({*EXCHANGES} - {*EXCHANGES[::4]}))])
def test_an_exchange_of_three_wheels_is_told_with_the_way_back(order: tuple[int, ...], signs: tuple[int, ...]) -> None:
    names = "abc"
    # Recorded column i holds signs[i] * wheel order[i]; the warning names the column that each wheel is found in.
    found_in = {wheel: (column, sign) for column, (wheel, sign) in enumerate(zip(order, signs, strict=True))}
    way_back = ", ".join(
        f"{names[wheel]} <- {'-' if sign < 0 else ''}{names[column]}"
        for wheel, (column, sign) in sorted(found_in.items())
    )
    runs = [rearranged(order, signs)(run) for run in recorded().trajectories]
    changed = make_dataset("changed", recorded().robot, recorded().sample_period, runs)
    explained = search(recorded_of(changed))  # wheels one place on are the robot turned by a third
    said = [mistakes[0] for mistakes in (explained.mistakes, *explained.alike) if len(mistakes) == 1]
    named = [mistake for mistake in said if mistake.kind.startswith("wheel")]
    if not named:  # told as a turned robot, two of whose wheels count the wrong way round
        assert {mistake.kind for mistake in explained.mistakes} == {"reference_turned", "wheel_negated"}
        return
    (mistake,) = named
    if order != (0, 1, 2):
        assert f"; the reference fits with omega of {way_back}" in mistake.what
        assert mistake.changes["wheel_order"] == [found_in[wheel][0] for wheel in range(3)]
    assert mistake.changes.get("wheel_signs", [1, 1, 1]) == [found_in[wheel][1] for wheel in range(3)]


@pytest.mark.parametrize("motion", ["turns on the spot only", *slow("straight runs only", "one turning run")])
@pytest.mark.parametrize("signs", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1)])
def test_flipped_signs_are_told_in_simpler_motions_too(motion: str, signs: tuple[int, ...]) -> None:
    assert "counted the wrong way round" in warnings_of(recorded(motion), rearranged((0, 1, 2), signs))


def test_runs_in_which_no_wheel_turns_beside_others_that_drive_are_named() -> None:
    first, second, *_ = (run.id for run in recorded().trajectories)
    still: Change = lambda run: replace(run, rates=1e-9 * run.rates) if run.id in (first, second) else run  # noqa: E731
    expected = "the reference moves in 2 trajectories though no wheel turns, which spoils every fit; leave them out: "
    runs = [still(run) for run in recorded().trajectories]
    warnings = make_dataset("x", recorded().robot, recorded().sample_period, runs).warnings
    assert expected + f"{first}, {second}" in "; ".join(warnings)


def test_runs_that_are_meant_to_stand_are_not_warned_of() -> None:
    first = recorded().trajectories[0].id

    def standing(run: Trajectory) -> Trajectory:
        return run if run.id != first else replace(run, rates=0 * run.rates, poses=0 * run.poses + run.start)

    assert warnings_of(recorded(), standing) == ""


def test_copies_of_training_runs_are_left_out_of_validation() -> None:
    flowers = recorded()
    first, second = flowers.split("train")[:2]
    copies = [replace(first, id="copy", split="validation"), replace(second, id="other", split="validation")]
    poses = second.poses + np.linspace(0, 1e-3, len(second.poses))[:, None]
    runs = [first, second, copies[0], replace(copies[1], poses=poses)]
    dataset = make_dataset("x", flowers.robot, flowers.sample_period, runs)
    assert [run.id for run in dataset.split("validation")] == ["other"]
    assert "left out of validation, as copies of training runs: copy" in dataset.warnings


@pytest.mark.parametrize(("motion", "robot"), [*((motion, "apr02") for motion in MOTIONS), ("flower", "mecanum")])
def test_sound_recordings_give_no_warning(motion: str, robot: str) -> None:
    wrapped = headings(lambda values: (values + math.pi) % (2 * math.pi) - math.pi)
    assert warnings_of(recorded(motion, robot)) == ""
    assert warnings_of(recorded(motion, robot, sparse=True)) == ""
    assert warnings_of(recorded(motion, robot), shifted(-40.0, 25.0, 2.5)) == ""
    assert warnings_of(recorded(motion, robot), shifted(0.0, 0.0, 3.0), wrapped) == ""


def test_a_robot_that_hardly_moved_gives_nothing() -> None:
    def hardly(run: Trajectory) -> Trajectory:
        return replace(run, rates=run.rates * 1e-3, poses=run.poses * 1e-3)

    assert warnings_of(recorded(), hardly) == ""
