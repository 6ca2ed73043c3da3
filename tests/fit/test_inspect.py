"""What is in a data set, and the directions of wheel rates that recordings drive."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fit_samples import noisy_trajectories
from hypothesis import given
from hypothesis import strategies as st
from motions import FLOWER, RING, driven
from sample_robots import WHEELED
from syrupy.assertion import SnapshotAssertion

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import DataError
from omnibench.fit.inspect import Inspection, inspect_dataset
from omnibench.fit.span import aligned, direction_in_words, directions_kept, driven_span, motion_in_words
from omnibench.robot.kinematics import Array, Robot, wheel_equations
from omnibench.testing.synthetic import synthetic_robot


@pytest.mark.parametrize("robot", WHEELED, ids=lambda robot: robot.name)
def test_wheels_that_never_turn_tell_nothing_of_any_robot(robot: Robot) -> None:
    t, poses = np.arange(1, 21) * 0.1, {"t": [0.0, 1.0, 2.0]} | dict.fromkeys(("x", "y", "theta"), np.zeros(3))
    names = [f"omega_{wheel}" for wheel in robot.wheel_names] + [f"steer_{wheel}" for wheel in robot.drive.steered]
    still = make_dataset("still", robot, wheels={"t": t} | dict.fromkeys(names, np.zeros(20)), poses=poses)
    inspection = inspect_dataset(still)
    assert inspection.driven_directions == 0
    assert not any(parameter.told for parameter in inspection.identifiability.parameters)
    assert {direction.state for direction in inspection.identifiability.directions} == {"undriven"}


def dataset(runs: list[Trajectory], wheels: int = 3) -> Dataset:
    robot = synthetic_robot(4 if wheels == 4 else 3)
    return make_dataset("synthetic", robot, 0.2, runs, description="d", source="s", licence="l", simulated=True)


def commanded() -> list[Trajectory]:
    """Twelve runs: eight to train of three commands in two sessions, four to validate of one."""
    commands = ["a", "a", "a", "b", "b", "c", "c", "c", "a", "a", "a", "a"]
    return [
        replace(
            run,
            command=command,
            split="train" if index < 8 else "validation",
            session="morning" if index < 5 else "evening",
            angles=np.cumsum(run.rates, axis=0),
        )
        for index, (run, command) in enumerate(zip(noisy_trajectories(), commands, strict=True))
    ]


@pytest.fixture(scope="module")
def found() -> Inspection:
    """The inspection of the commanded runs."""
    return inspect_dataset(dataset(commanded()))


def rounded(value: Any) -> Any:
    """A document with numbers of three digits: further ones depend on the machine."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.3g}") if isinstance(value, float) else value


def test_the_document_of_an_inspection_is_what_its_schema_says(found: Inspection, snapshot: SnapshotAssertion) -> None:
    # Noise is what a search for the likeliest finds, and the sign of a direction the machine's linear algebra.
    uncertain = {"directions": {"__all__": {"deviations", "direction"}}, "parameters": {"__all__": {"deviation"}}}
    kept = found.model_dump(mode="json", exclude={"identifiability": {"noise": True, **uncertain}})
    assert rounded(kept) == snapshot


def test_durations_ways_and_turns_are_those_of_the_runs(found: Inspection) -> None:
    runs, validation = commanded()[8:], found.splits["validation"]
    paths = [np.linalg.norm(np.diff(run.poses[:, :2], axis=0), axis=1).sum() for run in runs]
    turns = [abs(run.poses[-1, 2] - run.poses[0, 2]) for run in runs]
    expected = (sum(run.times[-1] for run in runs), sum(paths), sum(turns))
    assert (validation.duration_s, validation.distance_m, validation.turned_rad) == pytest.approx(expected)


def test_irregular_periods_are_shown_with_their_range_and_angles_only_where_every_run_has_them() -> None:
    first, *rest = commanded()
    irregular = replace(first, times=first.times + 0.05 * (np.arange(len(first.times)) == 3), angles=None)
    inspection = inspect_dataset(dataset([irregular, *rest]))
    assert inspection.sample_period_range_s == pytest.approx((0.15, 0.25))
    assert not inspection.has_angles


def test_the_direction_that_mecanum_wheels_cannot_drive_is_named_as_expected() -> None:
    runs = [replace(run, command="c") for run in noisy_trajectories(4)]
    inspection = inspect_dataset(dataset(runs, wheels=4))
    assert (inspection.undriven, inspection.driven_directions) == (("fl - fr - rl + rr",), 3)
    assert inspection.driven_shares[3] < 1e-2 < inspection.driven_shares[2]
    assert "fl - fr - rl + rr, as for any robot on four wheels that does not slip" in inspection.findings[0]


def test_straight_runs_of_three_wheels_leave_the_common_turn() -> None:
    straight = [run for index, run in enumerate(commanded()) if index % 3 == 1]
    inspection = inspect_dataset(dataset(straight))
    assert inspection.undriven == ("a + b + c",)
    assert "a + b + c (turning on the spot)" in inspection.findings[0]
    assert inspection.findings[0].endswith("record turns, on the spot or while driving")


@pytest.mark.parametrize(("split", "missing"), [("train", "validation"), ("validation", "train")])
def test_a_split_that_is_empty_is_told_and_all_runs_are_judged(split: str, missing: str) -> None:
    inspection = inspect_dataset(dataset([replace(run, split=split) for run in commanded()]))
    (finding,) = inspection.findings
    assert f"marked {missing}" in finding
    assert set(inspection.splits) == {split}
    assert len(inspection.identifiability.directions) == 3


def test_missing_commands_are_told() -> None:
    inspection = inspect_dataset(dataset([replace(run, command=None) for run in commanded()]))
    assert any("no commands" in finding for finding in inspection.findings)
    assert inspection.splits["train"].commands == 0


def test_a_real_recording_of_hours_is_inspected(omni3: Dataset) -> None:
    inspection = inspect_dataset(omni3)
    assert inspection.trajectories == 67
    assert inspection.driven_directions == 3
    assert inspection.findings == ()


@pytest.mark.parametrize(
    ("left", "beginning"), [(0.05, "these recordings hardly turn the robot: they drive"), (0.25, "the runs drive")]
)
def test_a_motion_that_is_hardly_driven_is_told_with_its_share(left: float, beginning: str) -> None:
    runs = [replace(run, rates=run.rates - (1 - left) * run.rates.mean(axis=1, keepdims=True)) for run in commanded()]
    inspection = inspect_dataset(dataset(runs))
    turning = next(each for each in inspection.identifiability.directions if each.motion == "turning on the spot")
    finding = inspection.findings[0]
    assert finding.startswith(f"{beginning} the wheels along a + b + c (turning on the spot) with ")
    assert f" {100 * turning.share:.1f} % of the strongest motion" in finding


def run_at(rates: Array, samples: int = 10, poses: int = 6) -> Trajectory:
    """A run at constant wheel rates (N,) for 2 s."""
    times = 0.2 * np.arange(1, samples + 1)
    stamps = np.linspace(0, times[-1], poses)
    return Trajectory("run", "train", times, np.tile(rates, (samples, 1)), stamps, np.zeros((poses, 3)))


def test_mecanum_wheels_leave_the_direction_that_would_make_them_slip_and_three_wheels_none() -> None:
    omni, mecanum = (driven_span(noisy_trajectories(wheels, encoder=0.0)) for wheels in (3, 4))
    assert (omni.driven.shape, omni.null.shape) == ((3, 3), (0, 3))
    assert (mecanum.driven.shape, mecanum.null.shape) == ((3, 4), (1, 4))
    np.testing.assert_allclose(mecanum.null @ wheel_equations(synthetic_robot(4).wheels), 0, atol=1e-12)
    noisy = driven_span(noisy_trajectories(4, encoder=0.05))  # encoder noise does not count as driving
    assert noisy.null.shape == (1, 4)
    assert noisy.shares[3] > 1e-4 > 1e-12 > mecanum.shares[3]


def test_a_direction_is_named_with_its_shares() -> None:
    assert direction_in_words(np.array([-0.25, 0.001, 0.5]), ("a", "b", "c")) == "- 0.5 a + c"


@given(rank=st.integers(1, 4), wheels=st.integers(4, 6), seed=st.integers(0, 2**16))
def test_driven_and_null_directions_project_onto_complements(rank: int, wheels: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.normal(size=(wheels, wheels)))[0][:rank]
    span = driven_span([run_at(3.0 * direction) for direction in directions])
    assert len(span.driven) == rank
    both = np.vstack([span.driven, span.null])
    np.testing.assert_allclose(both @ both.T, np.eye(wheels), atol=1e-12)
    np.testing.assert_allclose(span.null @ directions.T, 0, atol=1e-12)


def test_shares_are_of_the_direction_that_is_driven_most_and_between_two_lie_between_theirs() -> None:
    span = driven_span([run_at(np.array([4.0, 0, 0])), run_at(np.array([0, 1.0, 0]))])
    np.testing.assert_allclose(span.shares, [1.0, 0.25, 0.0], atol=1e-12)
    between = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    assert span.share(between) == pytest.approx(np.sqrt((1 + 0.25**2) / 2))


@pytest.mark.parametrize("poses", [2, 3])
def test_few_increments_still_give_a_direction_for_every_wheel(poses: int) -> None:
    span = driven_span([run_at(np.array([1.0, 2.0, 2.0, 0.0]), poses=poses)])
    assert (span.driven.shape, span.null.shape, span.shares.shape) == ((1, 4), (3, 4), (4,))
    np.testing.assert_allclose(np.abs(span.driven[0]), [1 / 3, 2 / 3, 2 / 3, 0], atol=1e-12)


def test_wheels_that_never_turn_drive_nothing_and_no_trajectories_are_refused() -> None:
    span = driven_span([run_at(np.zeros(3))])
    assert (span.driven.shape, span.null.shape) == ((0, 3), (3, 3))
    with pytest.raises(DataError, match="no trajectories"):
        driven_span([])


ROBOT = synthetic_robot()


def test_what_is_driven_with_less_than_a_tenth_is_weak() -> None:
    span = driven_span([run_at(np.array([4.0, 0, 0])), run_at(np.array([0, 0.41, 0])), run_at(np.array([0, 0, 0.39]))])
    assert (len(span.driven), len(span.strong), len(span.weak), len(span.null)) == (3, 2, 1, 0)
    np.testing.assert_allclose(np.abs(span.weak), [[0, 0, 1]], atol=1e-12)
    assert [span.state(direction) for direction in np.eye(3)] == ["driven", "driven", "weak"]


def test_translation_with_slip_keeps_the_turn_of_the_design_exactly_unless_it_is_to_be_fitted() -> None:
    slipping, exact = driven_span(driven(RING, slip=0.02)), driven_span(driven(RING))
    np.testing.assert_allclose(directions_kept(ROBOT, slipping, "keep"), np.ones((1, 3)) / np.sqrt(3), atol=1e-15)
    assert directions_kept(ROBOT, slipping, "fit").shape == (0, 3)
    assert directions_kept(ROBOT, exact, "fit").shape == (1, 3)  # what is not driven at all is kept


@pytest.mark.parametrize("wheels", [3, 4])
def test_nothing_changes_where_every_direction_is_driven(wheels: int) -> None:
    span = driven_span(driven(FLOWER, wheels=wheels))
    np.testing.assert_array_equal(directions_kept(synthetic_robot(wheels), span, "keep"), span.null)


@given(size=st.integers(1, 4), seed=st.integers(0, 2**16))
def test_aligned_directions_are_orthonormal_and_stay_close_to_their_span(size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    space = np.linalg.qr(rng.normal(size=(4, 4)))[0][:size]
    turned = aligned(space, synthetic_robot(4))
    np.testing.assert_allclose(turned @ turned.T, np.eye(size), atol=1e-9)
    assert np.linalg.norm(turned @ space.T @ space - turned, axis=1).max() < 0.25


def test_a_span_that_holds_motions_is_named_by_them() -> None:
    robot = synthetic_robot(4)
    rng = np.random.default_rng(0)
    mixed = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    first, *others, last = (motion_in_words(direction, robot) for direction in aligned(mixed, robot))
    assert (first, set(others), last) == ("turning on the spot", {"moving along x", "moving along y"}, "")


@pytest.mark.parametrize(
    ("twist", "words"),
    [
        ((0.0, 0.0, -0.3), "turning on the spot"),
        ((-0.2, 0.0, 0.0), "moving along x"),
        ((0.0, 0.2, 0.0), "moving along y"),
        ((0.2, -0.2, 0.0), "moving at 135 deg"),
        ((0.2, 0.0, 1.0), "moving along x while turning"),
    ],
)
def test_a_direction_is_told_by_what_the_designed_robot_does(twist: tuple[float, float, float], words: str) -> None:
    rates = wheel_equations(ROBOT.wheels) @ np.array(twist)
    assert motion_in_words(rates / np.linalg.norm(rates), ROBOT) == words
