"""Wheels, units and references that are misread are named with what mends them; sound recordings give nothing."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import cycle, product

import numpy as np
import pytest
from config_robots import NAMES, experiment
from hypothesis import given, settings
from hypothesis import strategies as st
from lanes import slow, slow_cases

from omnibench.check.misreadings import Explained, Recorded, search
from omnibench.check.source import recorded as read_as_recorded
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.recording_options import corrected_robot
from omnibench.data.references import Reference, References
from omnibench.robot.kinematics import Array
from omnibench.simulate.source import simulate_dataset

Change = Callable[[Trajectory], Trajectory]


@cache
def recorded(robot: str) -> Dataset:
    """One run of every command of a config's robot, without noise."""
    return simulate_dataset(experiment(robot)).dataset


def explained(dataset: Dataset, change: Change = lambda run: run) -> Explained:
    """What the search says of a data set whose runs are changed."""
    runs = [change(run) for run in dataset.trajectories]
    changed = make_dataset("changed", dataset.robot, dataset.sample_period, runs).trajectories
    return search(Recorded(dataset.robot, [run.log(run.pose_times) for run in changed], [run.poses for run in changed]))


def rates(change: Callable[[Array], Array]) -> Change:
    return lambda run: replace(run, rates=change(run.rates))


def poses(change: Callable[[Array], Array]) -> Change:
    return lambda run: replace(run, poses=change(run.poses))


def turned(degrees: float) -> Change:
    """Headings that are constantly off."""
    return poses(lambda values: np.column_stack([values[:, :2], values[:, 2] + math.radians(degrees)]))


def one(run: Trajectory, factor: float) -> Trajectory:
    factors = np.ones(run.rates.shape[1])
    factors[0] = factor
    return replace(run, rates=run.rates * factors)


CHANGES: dict[str, tuple[Change, str]] = {
    "all negated": (rates(np.negative), "wheels_negated"),
    "all times 4": (rates(lambda values: 4 * values), "wheel_scale"),
    "rpm": (rates(lambda values: values * 60 / (2 * math.pi)), "wheel_unit"),
    "degrees a second": (rates(np.degrees), "wheel_unit"),
    "mm": (poses(lambda values: values * (1e3, 1e3, 1)), "position_unit"),
    "degrees": (poses(lambda values: values * (1, 1, 180 / math.pi)), "heading_unit"),
    "heading mirrored": (poses(lambda values: values * (1, 1, -1)), "reference_mirrored"),
    "y mirrored": (poses(lambda values: values * (1, -1, 1)), "reference_mirrored"),
    "x and y exchanged": (poses(lambda values: values[:, [1, 0, 2]]), "reference_mirrored"),
    "turned": (turned(40.0), "reference_turned"),
}
EVERY_WHEEL, STEERED = ("diff", "skid", "mecanum"), ("tricycle", "car", "swerve")


@pytest.mark.parametrize("robot", NAMES)
def test_a_sound_recording_is_misread_in_nothing(robot: str) -> None:
    assert explained(recorded(robot)).mistakes == ()


@pytest.mark.parametrize(
    ("change", "robot"),
    [*zip(CHANGES, cycle(EVERY_WHEEL), strict=False), *slow_cases(*zip(CHANGES, cycle(STEERED), strict=False))],
)
def test_a_mistake_is_named(change: str, robot: str) -> None:
    made, kind = CHANGES[change]
    found = explained(recorded(robot), made)
    named = [found.mistakes, *found.alike]
    assert kind in {mistake.kind for mistakes in named for mistake in mistakes}


@pytest.mark.parametrize("robot", EVERY_WHEEL)
@pytest.mark.parametrize(("factor", "kind"), [(-1.0, "wheel_negated"), (2.0, "wheel_scale"), (0.25, "wheel_scale")])
def test_one_wheel_that_is_misread_is_named(factor: float, kind: str, robot: str) -> None:
    (mistake,) = explained(recorded(robot), lambda run: one(run, factor)).mistakes
    assert mistake.kind == kind
    assert mistake.where == f"wheel {recorded(robot).robot.wheel_names[0]}"


@pytest.mark.parametrize("robot", EVERY_WHEEL)
def test_exchanged_wheels_come_with_the_way_back(robot: str) -> None:
    order = [1, 0, *range(2, len(recorded(robot).robot.wheel_names))]
    found = explained(recorded(robot), rates(lambda values: values[:, order]))
    changes = [mistake.changes for mistakes in (found.mistakes, *found.alike) for mistake in mistakes]
    assert {"wheel_order": order} in changes


def misdesigned(key: str, factor: float, *wheels: str) -> Dataset:
    """The recording of a robot, in whose file a value of some wheels is a factor too large."""
    robot = recorded("diff").robot
    values = {wheel.name: {key: factor * getattr(wheel, key)} for wheel in robot.wheels if wheel.name in wheels}
    return replace(recorded("diff"), robot=corrected_robot(robot, values, None))


@pytest.mark.parametrize("factor", [0.6, 1.66, 2.0, 6.9])
def test_a_track_that_is_off_is_named_however_little_it_is_beyond_a_calibration(factor: float) -> None:
    dataset = misdesigned("y", factor, *recorded("diff").robot.wheel_names)
    found = explained(dataset)
    (mistake,) = found.mistakes
    assert (mistake.kind, found.alike) == ("design_distance", ())
    for wheel in recorded("diff").robot.wheels:
        assert mistake.changes["wheels"][wheel.name]["y"] == pytest.approx(wheel.y, rel=0.05)


@pytest.mark.parametrize("factor", [0.75, 1.3])
@pytest.mark.parametrize("every", [False, True])
def test_a_radius_that_is_off_is_named_of_one_wheel_and_of_all(every: bool, factor: float) -> None:
    robot = recorded("diff").robot
    wrong = robot.wheels if every else robot.wheels[:1]
    (mistake,) = explained(misdesigned("radius", factor, *(wheel.name for wheel in wrong))).mistakes
    assert mistake.kind == "design_radius"
    assert mistake.changes["wheels"] == {
        wheel.name: {"radius": pytest.approx(wheel.radius, rel=0.1)} for wheel in wrong
    }


@pytest.mark.parametrize(("counted", "first"), [(False, "design_radius"), (True, "wheel_scale")])
def test_a_diameter_given_as_radius_comes_first_unless_ticks_may_be_counted_twice(counted: bool, first: str) -> None:
    robot = recorded("diff").robot
    recording = replace(read_as_recorded(misdesigned("radius", 2.0, *robot.wheel_names)), counted=counted)
    found = search(recording)
    by_kind = {mistake.kind: mistake.changes for mistake in (*found.mistakes, *(each[0] for each in found.alike))}
    assert [mistake.kind for mistake in found.mistakes] == [first]
    assert by_kind["design_radius"]["wheels"] == {wheel.name: {"radius": wheel.radius} for wheel in robot.wheels}
    assert by_kind["wheel_scale"] == {"rate_factors": [2.0, 2.0]}


def positions_alone(run: Trajectory) -> Trajectory:
    """A run of which only the positions of every second are known, to 5 mm, in a frame of their own."""
    rng, rows = np.random.default_rng(len(run.times)), np.searchsorted(run.pose_times, np.arange(0, run.times[-1], 1.0))
    seen = run.poses[rows, :2] + rng.normal(0, 0.005, (len(rows), 2))
    fixes = [
        Reference("position", tuple(each), 0.005, float(t)) for each, t in zip(seen, run.pose_times[rows], strict=True)
    ]
    references = References.of(fixes, end=float(run.times[-1]))
    return replace(run, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=references)


def seen_at(run: Trajectory, x: float, y: float) -> Trajectory:
    """A run whose poses are of a point of the robot, m."""
    place = (x + 1j * y) * np.exp(1j * run.poses[:, 2])
    return replace(run, poses=run.poses + np.column_stack([place.real, place.imag, 0 * place.real]))


SPARSE = ("none", "one negated", "all times 4", "y mirrored")
OTHERS = [*product(SPARSE, ("skid", *STEERED))]
OTHERS.remove(("one negated", "car"))  # the rates of both rear wheels make one signal


@pytest.mark.parametrize(
    ("change", "robot"), [*product(SPARSE, ("diff",)), *slow_cases(*product(SPARSE, ("mecanum",)), *OTHERS)]
)
def test_positions_without_headings_tell_a_misread_recording(change: str, robot: str) -> None:
    made, kind = CHANGES.get(change, (lambda run: one(run, -1.0) if change == "one negated" else run, "wheel_negated"))
    runs = [positions_alone(made(run)) for run in recorded(robot).trajectories]
    found = search(read_as_recorded(replace(recorded(robot), trajectories=tuple(runs))))
    kinds = {mistake.kind for mistakes in (found.mistakes, *found.alike) for mistake in mistakes}
    if change == "none":
        assert kinds == set()
    else:
        # One wheel that drives is every wheel.
        assert {kind, kind.replace("wheel_", "wheels_")} & kinds


@pytest.mark.parametrize("robot", ["diff", "mecanum", *slow(*STEERED)])
def test_a_tracked_point_off_the_centre_is_told_by_positions_without_headings(robot: str) -> None:
    reach = recorded(robot).robot.reach
    x, y = 1.2 * reach, -0.6 * reach
    runs = [positions_alone(seen_at(run, x, y)) for run in recorded(robot).trajectories]
    found = search(read_as_recorded(replace(recorded(robot), trajectories=tuple(runs))))
    assert [mistake.kind for mistake in found.mistakes] == ["design_mount"]
    mounts = [mistake.changes["mount"] for mistakes in (found.mistakes, *found.alike) for mistake in mistakes]
    assert any((mount["x"], mount["y"]) == pytest.approx((x, y), abs=0.1 * reach) for mount in mounts)


def test_runs_of_one_motion_do_not_tell_whether_a_tracked_point_is_ahead_or_behind() -> None:
    reach = recorded("diff").robot.reach
    runs = [positions_alone(seen_at(run, -reach, reach)) for run in recorded("diff").trajectories]
    found = search(read_as_recorded(replace(recorded("diff"), trajectories=tuple(runs))))
    ahead, behind = (mistake for mistakes in (found.mistakes, *found.alike) for mistake in mistakes)
    assert ahead.changes["mount"]["x"] == pytest.approx(-behind.changes["mount"]["x"], abs=0.1 * reach)
    assert "would tell" in behind.what


@settings(max_examples=8, deadline=None)
@given(st.floats(-180, 180))
def test_the_angle_of_a_turned_reference_is_told(degrees: float) -> None:
    found = explained(recorded("diff"), turned(degrees))
    if abs(degrees) < 5:
        assert found.mistakes == ()
    elif abs(degrees) > 15:
        changes = {key: value for mistake in found.mistakes for key, value in mistake.changes.items()}
        off = changes.get("heading_offset_deg", 0.0) + degrees
        assert abs(math.remainder(off, 360)) < 2.0


@pytest.mark.parametrize("name", ["omni3", "tricyc", *slow("omni4", "robotino", "diff")])
def test_real_recordings_are_misread_in_nothing(name: str, request: pytest.FixtureRequest) -> None:
    dataset = request.getfixturevalue(name)
    for part in (slice(0, None, 4), slice(0, len(dataset.trajectories) // 8), slice(-6, None)):
        assert explained(replace(dataset, trajectories=dataset.trajectories[part])).mistakes == ()


@pytest.mark.parametrize("change", ["all negated", "rpm", "mm", "degrees", "y mirrored", "turned"])
def test_mistakes_of_a_real_robot_are_named(change: str, omni3: Dataset) -> None:
    made, kind = CHANGES[change]
    found = explained(replace(omni3, trajectories=omni3.trajectories[::8]), made)
    assert [mistake.kind for mistake in found.mistakes] == [kind]
