"""Calibrations of data sets: omnidirectional and wheeled robots, and several sessions."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import Command, refused
from corelli import corelli_dataset, half
from fit_samples import design_of, noisy_trajectories
from hidden.session_sets import session_set
from lanes import slow, slow_cases
from motions import RING, driven
from report_page import on_terminal
from sample_robots import CAR, DIFFERENTIAL, TRICYCLE, WHEELED
from wheeled_recordings import PERIOD, path, recorded

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import save_dataset
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome, calibration_of_fit
from omnibench.fit.evaluate import evaluate, final_errors
from omnibench.fit.geometry import GeometryLimits, WheelGeometry
from omnibench.fit.problem import Budget
from omnibench.fit.sessions import SessionComparison, compare_sessions
from omnibench.progress import Progress
from omnibench.registry import costs
from omnibench.report.calibration_report import CalibrationResult
from omnibench.report.terminal import print_result
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.testing.synthetic import synthetic_robot

ROBOT = synthetic_robot()


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Eight runs to train and four to validate."""
    runs = noisy_trajectories()
    held_out = (replace(run, split="validation") for run in runs[8:])
    return make_dataset("synthetic", ROBOT, 0.2, [*runs[:8], *held_out], simulated=True)


def test_a_calibration_has_the_robot_and_the_matrix_found_and_its_provenance_tells_where_it_comes_from(
    dataset: Dataset,
) -> None:
    choices = {"options": {"tolerance": 1e-3}, "cost": "trajectory", "box": "paper", "integration": "euler", "seed": 7}
    run = calibrate(dataset, "crs", **choices)
    origin = run.calibration.provenance
    assert (origin.dataset, origin.dataset_hash, origin.simulated) == ("synthetic", dataset.hash, True)
    assert (origin.calibrator, origin.seed, origin.cost, origin.box) == ("crs", 7, "trajectory", "paper")
    assert origin.options == {"population": None, "tolerance": 1e-3, "step": 1e-8}
    assert origin.versions == package_versions()
    assert (origin.outcome, origin.reason) == ("converged", run.result.reason)
    assert (run.calibration.robot, run.calibration.sample_period, run.calibration.integration) == (ROBOT, 0.2, "euler")
    np.testing.assert_array_equal(run.calibration.matrix_array, run.result.matrix)


@pytest.mark.parametrize("cost", ["final_pose", "final_position", "final_heading", "trajectory"])
def test_the_costs_of_the_provenance_are_of_the_cost_it_names(dataset: Dataset, cost: str) -> None:
    run = calibrate(dataset, "closed_form", cost=cost)
    origin = run.calibration.provenance
    assert origin.training_cost == run.result.cost
    objective = costs.create(cost)
    batch = objective.batch(dataset.split("validation"), "arc")
    errors = batch.poses(run.calibration.matrix_array[None]) - objective.reference(dataset.split("validation"))
    assert origin.validation_cost == pytest.approx(objective.combine(errors, batch.trajectory)[0], rel=1e-12)


def test_eq_6_of_the_provenance_is_that_of_evaluate_and_its_file_comes_back(dataset: Dataset, tmp_path: Path) -> None:
    calibration = calibrate(dataset).calibration
    splits = evaluate(calibration, dataset).splits
    assert calibration.provenance.training_cost == pytest.approx(splits["train"].cost, rel=1e-12)
    assert calibration.provenance.validation_cost == pytest.approx(splits["validation"].cost, rel=1e-12)
    write_calibration(calibration, tmp_path / "calibration.yaml")
    assert read_calibration(tmp_path / "calibration.yaml") == calibration


def test_values_that_no_robot_has_lead_back_to_the_recordings(dataset: Dataset) -> None:
    choices = {"calibrator": "crs", "seed": 1, "cost": "final_pose", "box": "row", "outcome": "converged"}
    with pytest.raises(DataError, match=r"^calibration 'far': matrix.*; check the recordings for poses and rates far"):
        calibration_of_fit("far", dataset, np.full((3, 3), 1e9), choices, integration="arc")


def test_only_training_runs_matter(dataset: Dataset) -> None:
    spoilt = [
        replace(run, poses=run.poses * [1.2, 1.0, 1.0]) if run.split == "validation" else run
        for run in dataset.trajectories
    ]
    alone = make_dataset("train only", ROBOT, 0.2, dataset.split("train"))
    first, second, third = (
        calibrate(each).calibration for each in (dataset, make_dataset("x", ROBOT, 0.2, spoilt), alone)
    )
    assert first.matrix == second.matrix == third.matrix
    assert third.provenance.validation_cost is None


def test_the_same_seed_gives_the_same_calibration(dataset: Dataset) -> None:
    matrices = [
        calibrate(dataset, "crs", seed=seed, budget=Budget(evaluations=500)).calibration.matrix for seed in (1, 1, 2)
    ]
    assert matrices[0] == matrices[1] != matrices[2]


def test_a_spent_budget_still_gives_a_calibration(dataset: Dataset) -> None:
    run = calibrate(dataset, "crs", budget=Budget(evaluations=100))
    assert run.result.outcome is Outcome.BUDGET
    assert run.calibration.provenance.outcome == "budget"


def test_parametric_searches_the_geometry_without_being_told_and_any_search_can(dataset: Dataset) -> None:
    limits = GeometryLimits(radius=0.05, distance=0.1, angle_deg=0.0)
    run = calibrate(dataset, "parametric", limits=limits, budget=Budget(evaluations=300))
    assert run.calibration.provenance.box == "limits"
    np.testing.assert_array_equal(run.result.vector[6:], [wheel.angle for wheel in ROBOT.wheels])
    other = calibrate(dataset, "crs", parameterisation="geometry", budget=Budget(evaluations=300))
    assert other.result.vector[0] == pytest.approx(0.148, rel=0.1)


def test_noise_and_covariance_are_written_with_a_calibration_that_was_fitted(dataset: Dataset) -> None:
    run = calibrate(dataset, "closed_form")
    assert run.calibration.noise == run.uncertainty.noise
    np.testing.assert_array_equal(run.calibration.covariance, run.uncertainty.covariance)
    assert run.warnings == ()
    design = calibrate(dataset, "theoretical")
    assert (design.uncertainty, design.calibration.noise, design.calibration.covariance) == (None, None, None)
    assert design.warnings == ()
    short = calibrate(dataset, "random_search", options={"candidates": 20})
    assert short.uncertainty is None
    assert "standard deviations away" in short.warnings[0]


def straight() -> Dataset:
    """Runs that translate only."""
    return make_dataset("straight", ROBOT, 0.1, driven(RING, slip=0.02))


@pytest.mark.parametrize("calibrator", ["closed_form", "crs"])
def test_what_the_data_do_not_identify_is_kept_and_told(calibrator: str) -> None:
    run = calibrate(straight(), calibrator, budget=Budget(evaluations=500))
    change = run.calibration.matrix_array - ROBOT.inverse_kinematic_matrix
    np.testing.assert_allclose(change.sum(axis=1), 0, atol=1e-15)
    assert run.warnings[0].endswith("kept at the design values")


def test_what_is_fitted_all_the_same_rests_on_slip_and_noise() -> None:
    run = calibrate(straight(), "closed_form", unidentified="fit")
    change = run.calibration.matrix_array - ROBOT.inverse_kinematic_matrix
    assert np.abs(change.sum(axis=1)).max() > 1e-4
    geometry = calibrate(straight(), "parametric", budget=Budget(evaluations=500))
    for warnings in (run.warnings, geometry.warnings):
        assert "rests on slip and noise" in warnings[0]


def test_progress_is_shown(dataset: Dataset) -> None:
    shown: list[Progress] = []

    def enough(event: Progress) -> None:
        shown.append(event)
        if len(shown) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate(dataset, "random_search", budget=Budget(evaluations=10**9), watch=enough)
    assert {event.task for event in shown} == {"random_search"}
    assert [event.done for event in shown] == sorted(event.done for event in shown)


@pytest.mark.parametrize(
    ("arguments", "error", "named"),
    [
        ({"calibrator": "closed_from"}, UnknownNameError, ("'closed_from'", "'closed_form'", "genetic", "theoretical")),
        ({"cost": "final"}, UnknownNameError, ("'final'", "final_pose")),
        ({"calibrator": "crs", "options": {"populations": 3}}, ConfigError, ("'crs'", "'populations'", "'population'")),
        ({"calibrator": "closed_form", "tolerance": 0.01}, ConfigError, ("closed_form", "map")),
    ],
)
def test_what_cannot_be_calibrated_so_is_refused_in_one_line_before_a_search(
    dataset: Dataset, arguments: dict[str, Any], error: type[Exception], named: tuple[str, ...]
) -> None:
    shown: list[Progress] = []
    with refused(error, *named):
        calibrate(dataset, **arguments, watch=shown.append)
    assert not shown


def test_an_empty_training_split_is_refused() -> None:
    held_out = [replace(run, split="validation") for run in noisy_trajectories()]
    with pytest.raises(DataError, match="held out: the training split is empty"):
        calibrate(make_dataset("held out", ROBOT, 0.2, held_out))


def test_motions_that_keep_the_design_are_named_below_the_elements() -> None:
    told = on_terminal(print_result, CalibrationResult(calibrate(straight(), "closed_form")), width=160)
    assert "the design values are kept along a + b + c" in told
    for choices in ({"calibrator": "closed_form", "unidentified": "fit"}, {"calibrator": "map"}):
        assert "kept along" not in on_terminal(print_result, CalibrationResult(calibrate(straight(), **choices)))


def test_an_angle_deviates_in_degrees(dataset: Dataset) -> None:
    run = calibrate(dataset)
    angle = next(each for each in run.parameters if each.name == "angle_a")
    row = next(
        line
        for line in on_terminal(print_result, CalibrationResult(run), width=160).splitlines()
        if line.startswith("angle_a")
    )
    assert f" {math.degrees(angle.value - ROBOT.wheels[0].angle):+.3f} deg " in row
    assert "%" not in row


# Fits of robots on every kind of wheel and of their steering, on simulated recordings and on real ones.

EVERY = [pytest.param(robot, id=robot.name) for robot in WHEELED]


def recording(robot: Robot, matrix: Array, noise: float = 1.0) -> Dataset:
    runs = recorded(robot, matrix, np.random.default_rng(5), noise)
    return make_dataset(robot.name, robot, PERIOD, runs, simulated=True)


def off_design(robot: Robot) -> Array:
    """A matrix (3, M) a few per cent off the design, in which no fixed wheel slides."""
    deviation = 0.02 * robot.row_scales[:, None] * np.random.default_rng(6).standard_normal((3, len(robot.drive.names)))
    return robot.inverse_kinematic_matrix + (deviation if robot.slides else robot.allowed_twists @ deviation)


MOUNTED = DIFFERENTIAL.model_copy(update={"name": "mounted", "mount": Mount(x=0.2, y=0.1, yaw=0.3)})


@pytest.mark.parametrize("robot", [*EVERY, pytest.param(MOUNTED, id="mounted")])
def test_recordings_without_noise_give_the_true_motions(robot: Robot) -> None:
    """A known tracked point is no slide."""
    truth = off_design(robot)
    found = calibrate(recording(robot, truth, 0.0), "closed_form").calibration.matrix_array
    driven = robot.signal_equations @ robot.motions.T
    np.testing.assert_allclose(found @ driven, truth @ driven, rtol=0, atol=1e-6)


def test_a_differential_drive_does_not_slide_unless_its_tracked_point_may_be_elsewhere() -> None:
    moved = DIFFERENTIAL.model_copy(update={"mount": Mount(x=0.02, y=0.0, yaw=0.02)}).inverse_kinematic_matrix
    dataset = recording(DIFFERENTIAL, moved, 0.3)
    known, fitted = (calibrate(dataset, "closed_form", mount=mount) for mount in ("known", "fit"))
    assert known.result.held == ("m21", "m22")
    assert not known.calibration.matrix_array[1].any()
    np.testing.assert_allclose(fitted.calibration.matrix_array[1], moved[1], rtol=0, atol=2e-4)


@pytest.mark.parametrize("robot", [DIFFERENTIAL, *slow(TRICYCLE, CAR)], ids=lambda robot: robot.name)
def test_the_geometry_is_found_by_a_search(robot: Robot) -> None:
    geometry = WheelGeometry(robot)
    hidden = geometry.start + geometry.scale * 0.02 * np.random.default_rng(7).standard_normal(len(geometry.start))
    dataset = recording(robot, geometry.matrices(hidden[None])[0], 0.0)
    run = calibrate(dataset, "parametric", unidentified="keep", mount="known")
    driven = robot.signal_equations @ robot.motions.T
    np.testing.assert_allclose(
        run.calibration.matrix_array @ driven, geometry.matrices(hidden[None])[0] @ driven, rtol=0, atol=1e-5
    )


def of_group(dataset: Dataset, *groups: str) -> Dataset:
    """The runs of some groups, to train."""
    runs = (run for run in dataset.trajectories if run.id.startswith(groups))
    return replace(dataset, trajectories=tuple(replace(run, split="train") for run in runs))


@pytest.mark.parametrize(
    ("name", "trained", "published"),
    [
        ("tricyc", "circular", {"circular": (0.042, 3.7), "square": (0.084, 3.2)}),
        *slow_cases(
            ("omni4", "circular", {"": (0.031, 3.4)}),
            ("diff", "circular", {"circular": (0.0090, 1.10), "square": (0.028, 1.9), "ivanjko": (0.0055, 0.95)}),
            ("diff", "square", {"square": (0.0108, 1.05), "circular": (0.0297, 4.06)}),
        ),
    ],
)
def test_a_real_robot_errs_less_than_by_published_methods(
    request: pytest.FixtureRequest, name: str, trained: str, published: dict[str, tuple[float, float]]
) -> None:
    """By the geometric mean over kinds of path of position and heading: of one kind a published method may err less."""
    dataset = request.getfixturevalue(name)
    model = calibrate(of_group(dataset, trained)).calibration.model
    ratios = []
    for judged, limits in published.items():
        errors = final_errors(model, of_group(dataset, judged).trajectories)
        found = np.hypot(errors[:, 0], errors[:, 1]).mean(), np.degrees(np.abs(errors[:, 2])).mean()
        ratios.append(np.array(found) / limits)
    assert np.exp(np.log(ratios).mean()) < 1.0, ratios


def misread(robot: Robot, gain: float = 1.0, zero: float = 0.0) -> Dataset:
    """Simulated runs whose true steering angle is gain times the measured one plus a zero, rad."""
    exact = recorded(robot, robot.inverse_kinematic_matrix, np.random.default_rng(3), 0.1)
    runs = [replace(run, steering=(run.steering - zero) / gain) for run in exact]
    return make_dataset(robot.name, robot, PERIOD, runs, simulated=True)


def weaving(coupling: float) -> Dataset:
    """Simulated runs of a tricycle that steers all the time, by which its wheel is turned along."""
    times, runs = PERIOD * np.arange(1, 101), []
    for number, phase in enumerate(np.linspace(0, 6, 8)):
        steering = 0.5 * np.sin(times + phase)[:, None]
        rates = np.full((100, 1), 6.0)
        middle = (np.vstack([steering[:1], steering[:-1]]) + steering) / 2
        moved = TRICYCLE.drive.signals(rates, middle) @ TRICYCLE.inverse_kinematic_matrix.T * PERIOD
        turned = np.diff(np.vstack([steering[:1], steering]), axis=0) / PERIOD
        stamps = np.concatenate([[0.0], times[9::10]])
        runs.append(
            Trajectory(
                str(number), "train", times, rates - coupling * turned, stamps, path(moved)[::10], steering=steering
            )
        )
    return make_dataset("weaving", TRICYCLE, PERIOD, runs, simulated=True)


def fitted(run: CalibrationRun) -> dict[str, float]:
    return {name: value for term in run.calibration.effects for name, value in term.parameters.items()}


@pytest.mark.slow
@pytest.mark.parametrize("calibrator", ["map", "closed_form"])
@pytest.mark.parametrize("gain", [0.4, 1.1, 5.5])
def test_the_gain_of_a_steering_is_found_even_where_it_is_far_off_and_predicts_the_runs(
    gain: float, calibrator: str
) -> None:
    dataset = misread(TRICYCLE, gain)
    run = calibrate(dataset, calibrator, cost="trajectory", steering="fit")
    assert fitted(run)["g"] == pytest.approx(gain - 1, abs=0.02 * gain)
    first = any("the steering was fitted first (steering gain" in warning for warning in run.warnings)
    assert first == (calibrator == "closed_form")
    paths = run.calibration.model.poses([each.reference_log for each in dataset.trajectories])
    errors = [poses[-1] - each.poses[-1] for poses, each in zip(paths, dataset.trajectories, strict=True)]
    assert np.abs(errors).mean() < 0.005


@pytest.mark.slow
def test_the_zero_of_a_car_s_steering_is_found() -> None:
    terms = calibrate(misread(CAR, 1.0, 0.03), steering="fit").calibration.effects
    (offset,) = [term.parameters["c"] for term in terms if term.name == "steering_offset"]
    assert offset == pytest.approx(0.03, abs=0.003)


def test_a_steering_that_turns_its_wheel_along_is_found() -> None:
    run = calibrate(weaving(0.4), steering="fit")
    assert fitted(run)["k"] == pytest.approx(0.4, abs=0.02)


def test_a_steering_is_fitted_of_a_robot_that_steers() -> None:
    runs = recorded(DIFFERENTIAL, DIFFERENTIAL.inverse_kinematic_matrix, np.random.default_rng(3))
    dataset = make_dataset("diff", DIFFERENTIAL, PERIOD, runs, simulated=True)
    with pytest.raises(ConfigError, match="robot diff"):
        calibrate(dataset, steering="fit")


def mean_distance(run: CalibrationRun, drive: Trajectory) -> float:
    (poses,) = run.calibration.model.poses([drive.reference_log])
    return float(np.hypot(*(poses - drive.poses[1:])[:, :2].T).mean())


@pytest.mark.slow
def test_a_real_tricycle_with_a_steering_gain_far_off_errs_less_than_its_authors_say() -> None:
    (drive,) = corelli_dataset().trajectories
    parts = corelli_dataset(window=12.0)  # s, as ``omnibench fetch corelli`` imports the drive
    every = replace(parts, trajectories=tuple(replace(part, split="train") for part in parts.trajectories))
    assert mean_distance(calibrate(every, "closed_form", cost="trajectory", steering="fit"), drive) <= 0.071


@pytest.mark.slow
def test_the_first_half_of_a_real_drive_predicts_the_second() -> None:
    (drive,) = corelli_dataset().trajectories
    parts = corelli_dataset(window=12.0)
    first = replace(parts, trajectories=parts.trajectories[: len(parts.trajectories) // 2])
    middle, end = float(drive.pose_times[-1] / 2), float(drive.pose_times[-1])
    assert mean_distance(calibrate(first, steering="fit"), half(drive, middle, end)) <= 0.15


# Sessions that differ, in recordings made without the code that compares them and of a real robot, and in commands.


def compared(dataset: Dataset, **changes: object) -> SessionComparison:
    """The comparison by the design's matrix, of runs that are changed."""
    model = OdometryModel(dataset.robot, dataset.robot.inverse_kinematic_matrix, "arc", (), dataset.sample_period)
    return compare_sessions(model, [replace(run, **changes) for run in dataset.trajectories])


def alone(dataset: Dataset, lone: int) -> SessionComparison:
    """The comparison of one run with all others, as two sessions."""
    names = ["lone" if index == lone else "others" for index in range(len(dataset.trajectories))]
    runs = tuple(replace(run, session=name) for run, name in zip(dataset.trajectories, names, strict=True))
    return compared(replace(dataset, trajectories=runs))


@pytest.mark.parametrize(
    ("wheels", "kind", "change", "chance"),
    # A chance so small that no noise is known so well is not given as a figure.
    [("abc", "all wheels", 0.02, "(chance < 10⁻⁹)"), ("b", "one wheel", 0.01, "(chance ")],
)
def test_a_session_with_larger_wheels_is_said_to_differ_and_by_how_much(
    wheels: str, kind: str, change: float, chance: str
) -> None:
    found = compared(session_set("small", 3, change=change, wheels=wheels))
    (difference,) = found.differences
    assert (difference.session, difference.others, difference.commands) == ("s2", ("s1",), 12)
    assert difference.kind == kind
    assert difference.radii[0].low < change < difference.radii[0].high
    (sentence,) = found.sentences
    assert "in s2 against s1, 12 commands" in sentence
    assert ("all wheels" if len(wheels) > 1 else "wheel b") in sentence
    assert "% larger (95 %" in sentence
    assert chance in sentence


def test_of_several_sessions_the_one_that_differs_is_named() -> None:
    found = compared(session_set("small_sessions", 5, change=-0.02))
    (difference,) = found.differences
    assert (difference.session, difference.others) == ("s4", ("s1", "s2", "s3"))
    assert "% smaller" in found.sentences[0]


@pytest.mark.parametrize(
    ("seed", "changes"),
    [
        (0, {"noise": "plain"}),
        (1, {"noise": "correlated"}),
        (2, {"noise": "mixed"}),
        (3, {"noise": "slip"}),
        (4, {"effect": "rotation_translation_coupling"}),  # what the model lacks in both sessions
        (1, {"validation": "flower"}),  # other commands from which nothing deviates
    ],
)
def test_sessions_that_are_alike_are_not_said_to_differ(seed: int, changes: dict[str, str]) -> None:
    assert compared(session_set("small", seed, **changes)) == SessionComparison()


@pytest.mark.parametrize("lone", [23, 101, 104, 108])  # those that the noise model alone would have said to differ
def test_a_run_that_is_a_session_of_its_own_is_judged_by_the_scatter_of_its_command(lone: int) -> None:
    assert alone(session_set("small", 1, noise="mixed"), lone) == SessionComparison()


def test_a_single_run_with_much_larger_wheels_is_said_to_differ() -> None:
    dataset = session_set("small", 2, change=0.05)
    runs = [run for run in dataset.trajectories if run.split == "train"]
    lone = next(run for run in dataset.trajectories if run.split == "validation")
    (difference,) = compared(replace(dataset, trajectories=(*runs, lone))).differences
    assert (difference.session, difference.runs, difference.commands) == ("s2", 1, 1)


def test_of_other_commands_it_is_said_that_sessions_and_commands_cannot_be_told_apart() -> None:
    found = compared(session_set("small", 1, effect="rotation_translation_coupling", validation="flower"))
    assert found.differences == ()
    assert found.other_commands is not None
    assert "other commands" in found.sentences[0]


def test_splits_stand_for_sessions_that_were_not_recorded() -> None:
    found = compared(session_set("small", 3, change=0.01), session=None)
    assert [(each.session, each.others) for each in found.differences] == [("validation", ("train",))]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({"session": "s1"}, "one session"), ({"command": None}, "repeats"), ({"poses": None}, "no trajectory")],
)
def test_what_cannot_be_compared_is_said_with_the_reason(changes: dict[str, object], reason: str) -> None:
    dataset = session_set("small", 3, change=0.01)
    if "poses" in changes:
        runs = [replace(run, poses=run.poses[:1], pose_times=run.pose_times[:1]) for run in dataset.trajectories]
        found = compared(replace(dataset, trajectories=tuple(runs)))
    else:
        found = compared(dataset, **changes)
    assert reason in found.untested
    assert found.sentences == ()
    assert [found.untested in doubt for doubt in found.doubts] == [True] * ("session" not in changes)


def test_a_session_that_shares_no_command_with_the_others_is_named() -> None:
    dataset = session_set("small_sessions", 5)
    renamed = [
        replace(run, command=f"{run.command}, other") if run.session == "s2" else run for run in dataset.trajectories
    ]
    (sentence,) = compared(replace(dataset, trajectories=tuple(renamed))).doubts
    assert "no run of s2" in sentence


def test_repetitions_that_agree_exactly_show_what_differs_and_nothing_else() -> None:
    dataset = session_set("small", 3, change=0.01)
    by_command = {(run.session, run.command): run for run in dataset.trajectories}
    same = {run.command: run for run in dataset.split("train")}

    def of(first: dict[object, object], key: object, run: object) -> object:
        return replace(run, **{name: getattr(first[key], name) for name in ("times", "rates", "poses", "pose_times")})

    alike = tuple(of(by_command, (run.session, run.command), run) for run in dataset.trajectories)
    assert [each.session for each in compared(replace(dataset, trajectories=alike)).differences] == ["s2"]
    none = tuple(of(same, run.command, run) for run in dataset.trajectories)
    assert compared(replace(dataset, trajectories=none)).differences == ()


@pytest.mark.slow
def test_squares_and_a_single_run_of_a_real_robot_are_not_said_to_be_another_session(omni3: Dataset) -> None:
    found = compared(omni3)
    assert found.differences == ()
    assert found.other_commands is not None
    assert alone(omni3, 32).differences == ()


WORDS = "The sessions differ: in s2 against s1, 12 commands"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data set whose validation session has larger wheels, and a calibration of its design."""
    dataset = session_set("small", 3, change=0.02)
    runs = [run for run in dataset.trajectories if run.repetition is not None and run.repetition < 4]
    save_dataset(replace(dataset, trajectories=tuple(runs)), tmp_path / "data")
    write_calibration(design_of(dataset, "arc"), tmp_path / "design.yaml")
    return tmp_path / "data"


@pytest.mark.slow
def test_evaluate_and_compare_say_after_their_verdict_that_the_sessions_differ(command: Command, data: Path) -> None:
    lines = command("evaluate", data.parent / "design.yaml", data).stdout.splitlines()
    assert lines[-3].startswith("held out (")
    assert lines[-1].startswith(WORDS)
    sets, calibrators = {"robot": {"path": str(data)}}, ["theoretical", "closed_form"]
    config = {"name": "sessions", "datasets": sets, "cost": "final_pose", "calibrators": calibrators}
    Path("compare.yaml").write_text(yaml.safe_dump(config | {"certificate": None}))
    told = command("compare", "compare.yaml", "-o", "results")
    assert WORDS in told.stdout, told.stderr
    assert WORDS in Path("results/report.html").read_text()
