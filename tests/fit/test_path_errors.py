"""Errors that calibrations predict on paths."""

import math
from dataclasses import replace

import numpy as np
import pytest
from sample_robots import CAR, DIFFERENTIAL, SWERVE, TRICYCLE, WHEELED
from scipy.stats import binom

from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.path_errors import (
    calibration_covariances,
    error_region,
    predicted_errors,
    regions_lack,
    slip_of,
)
from omnibench.robot.calibration import (
    Calibration,
    EffectTerm,
    Slip,
    covariance_rows,
    matrix_rows,
    read_calibration,
    write_calibration,
)
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import PathBatch, RunSamples, WheelLog
from omnibench.robot.paths import legs_of, tightest_arc, usual_paths, wheel_log

PERIOD = 0.05
SLIP = Slip(heading=0.01, way=0.008, position=0.004, runs=20)
COMMANDS = ((0.3, 0.0), (0.2, 0.5), (0.2, -0.5), (0.0, 0.6), (0.0, -0.6), (0.3, 0.2), (0.3, -0.2), (-0.3, 0.0))


def calibration_of(robot: Robot = DIFFERENTIAL, **fields: object) -> Calibration:
    """A calibration with the design's matrix, whose elements are known to 0.1 % of their rows."""
    matrix = robot.inverse_kinematic_matrix
    known = fields.pop("effects", ())
    deviations = np.append((0.001 * np.abs(matrix)).ravel(), [1e-3] * len(known))  # type: ignore[arg-type]
    given = {"matrix": matrix_rows(matrix), "slip": SLIP, "covariance": covariance_rows(np.diag(deviations**2))}
    return Calibration(
        name="known", robot=robot, sample_period=PERIOD, integration="arc", effects=known, **(given | fields)
    )


def ends(calibration: Calibration, path: str) -> Array:
    """The pose (3,) at a path's end by the calibration's model."""
    (poses,) = calibration.model.poses([wheel_log(calibration, legs_of(path, calibration.robot))])
    return poses[-1]


@pytest.mark.parametrize("robot", WHEELED, ids=lambda robot: robot.name)
def test_wheels_drive_the_path_that_was_asked_for(robot: Robot) -> None:
    known = calibration_of(robot)
    radius = max(1.0, tightest_arc(robot))
    side = max(1.0, 3 * tightest_arc(robot))
    wanted = {"straight 1.5": (1.5, 0, 0)} | {
        f"{kind} {size} {way}": (0, 0, sign * 2 * math.pi)
        for kind, size in (("circle", radius), ("square", side))
        for way, sign in (("left", 1), ("right", -1))
    }
    if not tightest_arc(robot):
        wanted |= {"turn 360": (0, 0, 2 * math.pi), "turn -90": (0, 0, -math.pi / 2)}
    for path, end in wanted.items():
        assert ends(known, path) == pytest.approx(end, abs=1e-9), path


def test_a_circle_has_its_radius_and_a_square_its_side() -> None:
    known = calibration_of()
    for path, length in (("circle 0.8 left", 2 * math.pi * 0.8), ("square 0.8", 4 * 0.8)):
        log = wheel_log(known, legs_of(path, DIFFERENTIAL))
        assert known.model.lengths([log])[0][-1] == pytest.approx(length)


def test_effects_of_the_wheels_are_counted_on_the_way() -> None:
    lost = EffectTerm(name="wheel_dead_zone", parameters={"c": -0.2})
    assert ends(calibration_of(effects=(lost,)), "straight 1.0") == pytest.approx((1, 0, 0), abs=1e-6)
    gear = (
        EffectTerm(name="steering_gain", parameters={"g": 3.0}),
        EffectTerm(name="steering_offset", parameters={"c": 0.05}),
    )
    assert ends(calibration_of(CAR, effects=gear), "circle 2.0 left") == pytest.approx((0, 0, 2 * math.pi), abs=1e-6)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("cirle 1.0 left", "did you mean 'circle 1.0 left'"),
        ("straight", "known: straight 1.0 (m), turn 360 (deg)"),
        ("straight 1.0 left", "is no path"),
        ("", "is no path"),
        ("square -1", "out of range"),
        ("circle 0 left", "out of range"),
        ("straight 1e9", "is no path"),
        ("turn 99999999", "out of range"),
    ],
)
def test_other_paths_are_refused_in_one_line(path: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        predicted_errors(calibration_of(), [path])
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("robot", [CAR, TRICYCLE], ids=lambda robot: robot.name)
def test_a_robot_that_cannot_turn_on_the_spot_has_its_tightest_arc(robot: Robot) -> None:
    radius = tightest_arc(robot)
    paths = [error.path for error in predicted_errors(calibration_of(robot))]
    assert f"circle {radius:.1f} left" in paths
    assert not any(path.startswith("turn") for path in paths)
    for path, message in (
        ("turn 90", f"its tightest is circle {radius:g} left"),
        (f"circle {radius / 2} left", "turns on radii of"),
        (f"square {radius}", "needs sides of"),
    ):
        with pytest.raises(ConfigError, match=message):
            predicted_errors(calibration_of(robot), [path])
    assert tightest_arc(SWERVE) == 0
    assert usual_paths(SWERVE)[1] == "turn 360"


def test_the_design_errs_by_its_bias_and_all_that_the_calibration_errs_by() -> None:
    matrix = DIFFERENTIAL.inverse_kinematic_matrix
    known = calibration_of(matrix=matrix_rows(matrix * 1.03))
    calibrated, design = predicted_errors(known, ["straight 2"])
    assert (calibrated.model, design.model) == ("calibration", "design")
    bias = 2 - 2 / 1.03
    assert bias < design.position_m < bias + calibrated.position_m
    assert design.position_95_m > calibrated.position_95_m > calibrated.position_m


def test_slip_grows_with_the_root_of_the_way_and_the_calibrations_error_in_proportion_to_it() -> None:
    exact = calibration_of(covariance=None, slip=Slip(heading=0.01, way=0.0, position=0.004, runs=20))
    short, _, long, _ = predicted_errors(exact, ["straight 1", "straight 4"])
    assert long.position_95_m == pytest.approx(2 * short.position_95_m)
    assert long.heading_95_rad == pytest.approx(2 * short.heading_95_rad)
    steady = calibration_of(slip=None)
    short, _, long, _ = predicted_errors(steady, ["straight 1", "straight 4"])
    assert long.heading_95_rad == pytest.approx(4 * short.heading_95_rad)


def test_regions_say_what_they_lack() -> None:
    assert regions_lack(calibration_of()) == ""
    assert "uncertainty alone" in regions_lack(calibration_of(slip=None))
    assert "slip of runs alone" in regions_lack(calibration_of(covariance=None))
    neither = calibration_of(slip=None, covariance=None)
    assert "are not known" in regions_lack(neither)
    assert predicted_errors(neither) == ()


def test_a_region_holds_the_share_that_it_says() -> None:
    rng = np.random.default_rng(1)
    root, bias = np.array([[3.0, 0, 0], [1, 0.5, 0], [0, 0.2, 2]]), np.array([2.0, -1, 1])
    errors = bias + rng.normal(size=(200_000, 3)) @ root.T
    sizes = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])
    place, place_95, heading, heading_95 = error_region(root @ root.T, bias, None)
    assert [place, heading] == pytest.approx([each.mean() for each in sizes], rel=0.01)
    assert [(each <= radius).mean() for each, radius in zip(sizes, (place_95, heading_95), strict=True)] == (
        pytest.approx([0.95, 0.95], abs=0.003)
    )
    assert error_region(root @ root.T, bias, 3)[1] > 1.3 * place_95


def test_slip_stays_in_the_file_and_old_files_have_none(tmp_path: object) -> None:
    for slip in (SLIP, None):
        file = tmp_path / "calibration.yaml"  # type: ignore[operator]
        write_calibration(calibration_of(slip=slip), file)
        assert read_calibration(file).slip == slip
        assert ("slip" in file.read_text()) == (slip is not None)


def test_runs_without_poses_tell_no_slip() -> None:
    tape = References.of([Reference("distance", 0.5, 0.001)], end=1.0)
    rates = np.full((20, 2), 10.0)
    run = Trajectory("a", "train", np.arange(1, 21) * PERIOD, rates, np.zeros(1), np.zeros((1, 3)), references=tape)
    assert slip_of(calibration_of(), [run]) is None


def slipping(rng: np.random.Generator, truth: Array, log: WheelLog, slip: Slip = SLIP) -> Array:
    """True poses (F + 1, 3) of a robot with a true matrix (3, M) whose wheels slip as a random walk."""
    samples = RunSamples.of([log.times])
    moved = (log.signals @ truth.T) * samples.durations[:, None]
    metres = np.hypot(moved[:, 0], moved[:, 1]) + DIFFERENTIAL.reach * np.abs(moved[:, 2])
    noise = rng.normal(size=moved.shape) * [slip.position, slip.position, slip.way] * np.sqrt(metres)[:, None]
    (path,) = PathBatch(samples, log.start[None], moved + noise, "arc").ends
    path[-1, 2] += rng.normal() * math.sqrt((slip.heading**2 - slip.way**2) * metres.sum())
    return path


def test_simulated_drives_end_within_their_regions_as_often_as_these_say() -> None:
    rng = np.random.default_rng(0)
    held = {"position": 0, "heading": 0}
    drives = 0
    for _ in range(5):
        radii, track = 0.01 * rng.normal(size=2), 0.02 * rng.normal()
        truth = DIFFERENTIAL.inverse_kinematic_matrix * (1 + radii) * [[1.0], [1.0], [1 + track]]
        runs = []
        for number in range(24):
            times = np.arange(1, 201) * PERIOD
            command = COMMANDS[number % len(COMMANDS)]
            rates = np.tile(np.linalg.solve(truth[[0, 2]], command), (len(times), 1))
            start = np.array([0.0, 0.0, 0.005 * rng.normal()])
            path = slipping(rng, truth, WheelLog(times, rates, start, times[-1:]))
            path[:, :2] += 0.002 * rng.normal(size=(len(path), 2))
            path[0] = 0.0
            runs.append(Trajectory(f"{number}", "train", times, rates, np.append(0.0, times)[::4], path[::4]))
        found = calibrate(make_dataset("slipping", DIFFERENTIAL, PERIOD, runs), "map").calibration
        predicted = [error for error in predicted_errors(found) if error.model == "calibration"]
        for error in predicted:
            log = wheel_log(found, legs_of(error.path, DIFFERENTIAL))
            for _ in range(10):
                drives += 1
                off = slipping(rng, truth, log)[-1] - found.model.poses([log])[0][-1]
                held["position"] += math.hypot(off[0], off[1]) <= error.position_95_m
                held["heading"] += abs(off[2]) <= error.heading_95_rad
    assert drives == 200
    low, high = binom.interval(0.99, drives, 0.95)
    assert low <= held["position"] <= high
    assert low <= held["heading"] <= high


def test_ends_of_logs_have_the_covariance_that_the_matrix_elements_spread() -> None:
    rng = np.random.default_rng(3)
    known = calibration_of(slip=None)
    log = wheel_log(known, legs_of("square 1.0", DIFFERENTIAL))
    drawn = rng.multivariate_normal(np.array(known.matrix).ravel(), np.array(known.covariance), 400)
    spread = np.cov([replace(known.model, matrix=row.reshape(3, 2)).poses([log])[0][-1] for row in drawn], rowvar=False)
    (predicted,) = calibration_covariances(known, [log])
    assert np.sqrt(np.diag(spread)) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.15, abs=1e-4)
