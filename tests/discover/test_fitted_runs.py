"""Fitted runs, experiments, and what residuals depend on."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from config_robots import NAMES as NAMES_OF_ROBOTS
from config_robots import settings as settings_of
from discovery_samples import (
    APR02,
    DEAD_ZONE,
    DELAY,
    ECCENTRICITY,
    Effects,
    lagging,
    look_alike,
    nothing,
    plain_fit,
    shorn,
    simulated,
)
from extended_samples import FORWARD, run_of
from hidden.sets import make_set
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lanes import slow
from outlier_study import EFFECT, TRUTH
from outlier_study import simulated as with_directions
from recording_samples import in_room
from sample_robots import DIFFERENTIAL, TRICYCLE
from scipy.stats import binomtest, chi2
from screening_samples import FIRST, SECOND, THIRD, screening
from wheeled_samples import driven

from omnibench.config import validate
from omnibench.data.dataset import Trajectory
from omnibench.data.splits import joined
from omnibench.discover import fit as fitting
from omnibench.discover.discover import discover_effects
from omnibench.discover.experiments import Choice, Members, Separation, candidate_runs, choose_runs, description_of
from omnibench.discover.fine_structure import fine_structure
from omnibench.discover.paths import slopes_by, slopes_by_delay
from omnibench.discover.report.figures import motor_grid
from omnibench.discover.report.residuals import NORMAL_95, Residuals, shares
from omnibench.discover.select import DISCREPANCY
from omnibench.discover.significance import (
    Family,
    Group,
    Significance,
    log_evidence,
    significance_of,
    together,
)
from omnibench.fit.noise import Whitener
from omnibench.fit.trajectory_fit import Whitened, usable_runs
from omnibench.registry import effects
from omnibench.robot.calibration import Noise
from omnibench.robot.effects.effect import ActuatorEffect, make_term
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import read_simulation, simulate_dataset

# Windows

ROBOT_MODEL = simulated(()).robot


def drive(seed: int, seconds: float = 60.0) -> Trajectory:
    """A drive whose poses are those of its own odometry."""
    rng, times = np.random.default_rng(seed), np.arange(1, int(seconds / 0.04) + 1) * 0.04
    rates = np.cumsum(rng.normal(0, 0.05, (len(times), 3)), axis=0)
    stamps = np.append(0.0, times[4::5])
    run = Trajectory("drive", "train", times, rates, stamps, np.zeros((len(stamps), 3)), started_at=7.0)
    (poses,) = OdometryModel.of_design(ROBOT_MODEL, "arc").poses([run.log(stamps[1:])])
    return replace(run, poses=np.vstack([run.start, poses]))


@given(seed=st.integers(0, 2**32 - 1))
def test_the_odometry_of_every_window_ends_where_the_drive_does(seed: int) -> None:
    windows = fitting.in_windows([drive(seed)])
    assert len(windows) == 15  # of 4 s
    model = OdometryModel.of_design(ROBOT_MODEL, "arc")
    for window, poses in zip(windows, model.poses([window.reference_log for window in windows]), strict=True):
        np.testing.assert_allclose(poses, window.poses[1:], atol=1e-9)
    assert windows[3].started_at == pytest.approx(7.0 + 12.0, abs=0.2)


def test_repetitions_and_many_runs_are_not_cut() -> None:
    repeated = [replace(drive(seed), id=str(seed), command="c") for seed in (1, 2)]
    assert fitting.in_windows(repeated) == tuple(repeated)
    many = [replace(drive(1, 9.0), id=str(number)) for number in range(30)]
    assert fitting.in_windows(many) == tuple(many)


# Outliers

UNIT = Noise(pose_position=1.0, pose_heading=1.0)
POSES = 20


def runs_of(*commands: str | None, poses: int = POSES) -> list[Trajectory]:
    """Runs of some commands with reference poses every 0.4 s."""
    run = run_of(FORWARD)
    stamps = 0.4 * np.arange(poses + 1)
    return [
        replace(run, id=f"{index}", command=command, pose_times=stamps, poses=np.zeros((poses + 1, 3)))
        for index, command in enumerate(commands)
    ]


def outliers(runs: list[Trajectory], residuals: np.ndarray | list[np.ndarray], noise: Noise = UNIT) -> list[list[int]]:
    return [np.flatnonzero(~mask).tolist() for mask in fitting.inliers_of(runs, list(residuals), noise)]


@pytest.mark.parametrize(("size", "left_out"), [(4.3, []), (4.7, [7])])
def test_a_pose_is_an_outlier_from_four_and_a_half_standard_deviations_on(size: float, left_out: list[int]) -> None:
    residuals = np.zeros((1, POSES, 3))
    residuals[0, 7, 2] = size
    assert outliers(runs_of("go"), residuals) == [left_out]


def test_a_pose_is_compared_with_what_the_others_of_its_run_predict() -> None:
    walked = np.cumsum(np.ones((POSES, 3)), axis=0)  # far off, yet as a walk goes
    jumped = walked.copy()
    jumped[9, 0] += 6.0
    noise = Noise(pose_position=0.2, pose_heading=0.2, walk_position=1.0, walk_heading=1.0)
    assert outliers(runs_of("go", "turn"), [walked, jumped], noise) == [[], [9]]


def test_noise_alone_makes_hardly_any_outlier() -> None:
    runs = runs_of(*(f"c{number}" for number in range(300)), poses=60)
    residuals = np.random.default_rng(3).standard_normal((300, 60, 3))
    assert sum(map(len, outliers(runs, residuals))) <= 3  # 0.4 expected of 18,000


def test_slam_that_jumps_in_one_repetition_is_left_out_there_alone() -> None:
    residuals = np.random.default_rng(1).standard_normal((8, POSES, 3))
    residuals[2, 5:7, :2] += 15.0
    residuals[6, -1, 2] -= 8.0
    assert outliers(runs_of(*"aaaabbbb"), residuals) == [[], [], [5, 6], [], [], [], [POSES - 1], []]


@pytest.mark.parametrize("commands", ["aaaabbbbccccdddd", "aabbccddeeffgghh"])
def test_what_recurs_at_a_stamp_of_a_command_is_signal(commands: str) -> None:
    residuals = np.random.default_rng(1).standard_normal((16, POSES, 3)) / 3
    residuals[[name == "a" for name in commands], 6] += 8.0
    assert not any(outliers(runs_of(*commands), residuals))


def test_a_jump_far_beyond_what_recurs_is_left_out() -> None:
    residuals = np.random.default_rng(1).standard_normal((8, POSES, 3)) / 3
    residuals[:4, 6] += 6.0
    residuals[1, 6] += 60.0
    assert outliers(runs_of(*"aaaabbbb"), residuals) == [[], [6], [], [], [], [], [], []]


def test_what_recurs_at_the_end_of_runs_is_signal_though_no_command_is_repeated_and_they_differ_in_length() -> None:
    runs = [run for count in range(12, 30) for run in runs_of(f"c{count}", poses=count)]
    rng = np.random.default_rng(1)
    residuals = [rng.standard_normal((len(run.pose_times) - 1, 3)) for run in runs]
    for number, of_run in enumerate(residuals):
        of_run[-1, 2] += 9.0 * (-1) ** number
    assert not any(outliers(runs, residuals))


def test_where_more_than_a_twelfth_of_the_poses_stand_out_the_limit_rises() -> None:
    residuals = np.random.default_rng(1).standard_normal((10, POSES, 3))
    for number, of_run in enumerate(residuals):  # nowhere twice at one stamp
        of_run[[number, number + 10], 0] = 5.5
    assert not any(outliers(runs_of(*"abcdefghij"), residuals))


def test_outliers_are_whitened_as_if_they_had_not_been_seen() -> None:
    stamps, residuals = 0.4 * np.arange(1, 9), np.random.default_rng(0).standard_normal((8, 3))
    inliers = np.array([True, False, True, True, False, False, True, False])
    noise = Noise(pose_position=0.4, walk_position=0.3, pose_heading=0.2, bias_heading=0.1)
    whiten, alone = fitting.InlierWhitener(noise, stamps, inliers), Whitener(noise, stamps[inliers])
    white = whiten(residuals)
    np.testing.assert_array_equal(white, alone(residuals[inliers]))
    np.testing.assert_allclose(whiten.of_differences(np.diff(residuals, axis=0, prepend=0.0)), white)
    unit = np.eye(24).reshape(8, 3, 24)
    precision = np.einsum("ksi,ksj->ij", whiten(unit), whiten(unit))
    np.testing.assert_allclose(whiten.weighted(white).ravel(), precision @ residuals.ravel(), atol=1e-12)


def extended_by(name: str, plain: fitting.Fit) -> fitting.Extended:
    effect = effects.create(name)
    linear = tuple(each for each in effect.parameters(plain.model.robot) if not each.choices)
    return fitting.extend(plain, [Group("effect", name, (), effect, linear)])


def test_an_effect_that_looks_like_outliers_is_estimated_without_bias() -> None:
    model = extended_by(EFFECT, plain_fit(with_directions(1)))
    assert model.fit.jumps == 0
    assert (np.abs(model.values - TRUTH) < 2 * model.covariance.reach[-3:]).all()


@pytest.mark.slow
def test_poses_come_back_and_jumps_stay_out_once_the_model_holds_the_effect() -> None:
    dataset = with_directions(1)
    thrown = {"0+0.0-0": 5, "7-0.4-2": 11}
    runs = [replace(run, poses=run.poses.copy()) for run in dataset.trajectories]
    for run in runs:
        if run.id in thrown:
            run.poses[1 + thrown[run.id], :2] += 0.2
    model = extended_by(EFFECT, plain_fit(replace(dataset, trajectories=tuple(runs))))
    strict = replace(model.fit, inliers=tuple(np.arange(len(mask)) % 3 > 0 for mask in model.fit.masks))
    again = fitting.with_noise(strict)
    assert {run.id: np.flatnonzero(~mask).tolist() for run, mask in zip(again.runs, again.masks, strict=True)} == {
        run.id: [thrown[run.id]] if run.id in thrown else [] for run in again.runs
    }


@pytest.mark.slow
def test_a_heading_that_is_thrown_at_the_end_of_runs_loses_no_final_pose() -> None:
    dataset = with_directions(1)
    commands = sorted({str(run.command) for run in dataset.trajectories})
    runs = [replace(run, poses=run.poses.copy()) for run in dataset.trajectories]
    for run in runs:
        place = commands.index(str(run.command))
        run.poses[-1, 2] += 0.08 * (-1) ** place * (place % 5 > 1)  # three commands of five, either way
    plain = plain_fit(replace(dataset, trajectories=tuple(runs)))
    assert all(mask[-1] for mask in plain.masks)


# What residuals depend on: slopes along paths, covariates and their significance.


@pytest.fixture(scope="module")
def eccentric() -> Residuals:
    """Residuals of a robot with an eccentric wheel a and a late reference."""
    return Residuals(discover_effects(simulated(ECCENTRICITY + DELAY)))


def test_an_eccentric_wheel_shows_its_amplitude_before_and_nothing_after(eccentric: Residuals) -> None:
    signals = eccentric.paths.signals
    angle, rate = signals.wheel_angles[:, 0], signals.rates[:, 0]
    columns = np.column_stack([rate * np.cos(angle), rate * np.sin(angle)])
    fitted = eccentric.fit(eccentric.paths.of_wheel(0, columns))
    values, errors = fitted.values, fitted.errors  # (2, before and after)
    noise = errors[0, 1]
    assert 0.012 < values[0, 0] < 0.022  # some of 0.02 is in the matrix, and in the start headings
    assert abs(values[1, 0]) < 4 * errors[1, 0]
    assert np.abs(values[:, 1]).max() < 4 * noise


def test_a_late_reference_shows_its_delay_in_every_run(eccentric: Residuals) -> None:
    paths = eccentric.paths
    of_run = shares(paths.run.astype(float), np.arange(len(eccentric.runs) + 1.0))
    before, after = eccentric.fit(slopes_by_delay(paths) * of_run[:, None, :]).values.T
    assert (before > 0).mean() > 0.9
    assert np.median(before) > 0.01  # of 0.06: the matrix takes up much
    assert abs(np.median(after)) < 0.005


def test_noise_leaves_the_bands_once_in_twenty_times() -> None:
    residuals = Residuals(nothing())
    paths = residuals.paths
    heading = paths.middle[:, 2]
    course = heading + np.arctan2(*paths.signals.twists[:, 1::-1].T)
    outside = []
    for angle in (course, *paths.signals.wheel_angles.T):
        bins = shares((np.degrees(angle) + 180) % 360 - 180, np.linspace(-180, 180, 13))
        for direction in np.eye(3):
            fitted = residuals.fit(paths.of_twist(np.tile(direction, (len(bins), 1)), bins))
            outside.append(np.abs(fitted.values[:, 0]) > NORMAL_95 * fitted.errors[:, 0])
    assert 0.0 < np.mean(outside) < 0.1


def test_residuals_are_as_seen_from_the_start_wherever_that_is() -> None:
    found = nothing()
    rng = np.random.default_rng(4)
    moves = {name: rng.uniform(-3, 3, 3) for name in found.trajectories}
    runs = [run for run in found.dataset.trajectories if run.id in moves]
    moved = tuple(replace(run, poses=in_room(moves[run.id], run.poses)) for run in runs)
    dataset = replace(found.dataset, trajectories=moved)
    turns = [np.array([0.0, 0.0, moves[name][2]]) for name in found.trajectories]
    before = tuple(in_room(turn, own) - turn for turn, own in zip(turns, found.before, strict=True))
    here, there = Residuals(found).commands, Residuals(replace(found, dataset=dataset, before=before)).commands
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(other.means[0], one.means[0], atol=1e-9)


def test_a_change_that_the_data_do_not_tell_has_no_value() -> None:
    residuals = Residuals(nothing())
    columns = np.zeros((len(residuals.paths.stamps), 3, 2))
    columns[:, 0, 0] = 1.0
    fitted = residuals.fit(columns)
    assert np.isfinite(fitted.values[0]).all()
    assert np.isnan(fitted.values[1]).all()
    twice = residuals.fit(np.repeat(columns[:, :, :1], 2, axis=2))
    assert np.isnan(twice.values).all()


def test_mean_final_residuals_are_those_of_the_runs() -> None:
    found = nothing()
    residuals = Residuals(found)
    command = residuals.commands[0]
    own = [
        before[-1]
        for name, before in zip(found.trajectories, found.before, strict=True)
        for run in found.dataset.trajectories
        if run.id == name and run.command == command.name
    ]
    assert command.runs == len(own) == 2
    np.testing.assert_allclose(command.means[0], np.mean(own, axis=0), atol=1e-12)  # starts at the origin, heading 0
    single = residuals.deviations(command.run.pose_times[-1:])[0]
    np.testing.assert_allclose(command.error, single / np.sqrt(2))


def test_motors_are_drawn_less_what_their_effects_explain() -> None:
    found = lagging()
    assert [effect.name for effect in found.effects] == ["motor_lag"]
    drawn = motor_grid(found, Residuals(found).runs)
    before, after = (
        np.array([value for value in trace.y if value is not None], dtype=float)
        for trace in drawn.figures[-1].plot.data
        if trace.mode == "lines+markers"
    )
    assert before.min() < -5  # % of what was told, while the wheels start
    assert np.abs(after).max() < 0.3 * np.abs(before).max()


@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.floats(-0.1, 0.1), min_size=12, max_size=12))
def test_errors_of_the_motion_are_recovered_from_the_residuals_that_they_make(values: list[float]) -> None:
    here = Residuals(nothing())
    bins = shares(here.paths.signals.elapsed, [0.0, 1.5, 3.0, 4.5, 20.0])
    columns = np.concatenate([here.paths.of_twist(np.tile(each, (len(bins), 1)), bins) for each in np.eye(3)], axis=2)
    made = columns @ np.array(values)
    found = replace(
        nothing(),
        trajectories=tuple(run.id for run in here.runs),
        before=tuple(made[part] for part in here.paths.parts),
    )
    fitted = Residuals(found).fit(columns)
    np.testing.assert_allclose(fitted.values[:, 0], values, atol=1e-9)


# All that odometry or reference have, in any robot; a slope of tyre_wear needs the name of a session.
NAMES = [
    entry.name
    for entry in effects.entries()
    if not issubclass(entry.cls, ActuatorEffect)
    and getattr(entry.cls, "in_catalogue", True)
    and not entry.cls.run_nuisance
]

# A learned effect is no candidate: nothing but training finds its weights.
NAMELESS = [
    entry.name
    for entry in effects.entries()
    if not getattr(entry.cls, "in_catalogue", True) and not getattr(entry.cls, "weighted", False)
]


def on_robot(robot: str) -> fitting.Fit:
    """The plain matrix fitted to a few runs of the APR-02 or of a config's robot, the tracked point off its centre."""
    if robot == "three":
        dataset = simulated((), start="random")
    else:
        given = settings_of(robot)
        weaving = {"variation": {"weave": 0.2, "period": 2.0}, "ramp": 0.3}
        changes = {
            "robot": given["robot"] | {"mount": {"x": 0.1, "y": -0.05, "yaw": 0.2}},
            "commands": given["commands"] | weaving,
            "train": {"seed": 1, "distance": 1.0},
        }
        dataset = simulate_dataset(validate(FlowerConfig, given | changes, robot)).dataset
    return plain_fit(dataset, usable_runs(dataset.split("train"))[:8])


@pytest.fixture(scope="module")
def fitted() -> fitting.Fit:
    return on_robot("three")


@pytest.mark.parametrize("robot", ["three", "tricycle", *slow(*sorted({*NAMES_OF_ROBOTS} - {"tricycle"}))])
def test_slopes_by_an_effect_are_the_models_own(robot: str) -> None:
    fit = on_robot(robot)
    applied = [name for name in NAMES if effects.create(name).applies(fit.model.robot)]
    for name in applied:
        check_slopes(fit, name)


@pytest.mark.parametrize("name", NAMELESS)
def test_slopes_by_an_effect_without_a_name_are_the_models_own(fitted: fitting.Fit, name: str) -> None:
    check_slopes(fitted, name)


def check_slopes(fitted: fitting.Fit, name: str) -> None:
    paths = fitting.paths_of(fitted)
    effect = effects.create(name)
    parameters = effect.parameters(paths.robot, ("earlier", "train"))
    for parameter in (each for each in parameters if not each.choices):
        base = {each.name: each.choices[0] if each.choices else 0.0 for each in parameters}
        step = 1e-3 * parameter.high

        def poses(value: float, base=base, parameter=parameter) -> np.ndarray:
            term = make_term(name, {**base, parameter.name: value}, paths.robot, sessions=("earlier", "train"))
            model = OdometryModel(paths.robot, paths.matrix, "arc", (term,), fitted.model.sample_period)
            return np.concatenate(model.reported(list(paths.logs)))

        expected = (poses(step) - poses(-step)) / (2 * step)
        slopes = slopes_by(paths, effect, [parameter.name], base)[..., 0]
        # A reference effect's slope is taken over a tenth of its range, along a path with corners at its ramps; in the
        # others the middle of a sample (40 ms) stands for all of it.
        tolerance = 0.05 if effect.stage == "reference" else 3e-4
        assert np.abs(slopes - expected).max() <= tolerance * np.abs(expected).max(), f"{name}, {parameter.name}"


def test_samples_put_together_give_the_same_slopes_of_what_varies_slowly(fitted: fitting.Fit) -> None:
    effect = effects.create("heading_drift")
    fine, coarse = (
        slopes_by(fitting.paths_of(fitted, together), effect, ["b"], {"b": 0.0}) for together in (0.0, 0.12)
    )
    assert np.abs(fine - coarse).max() < 2e-3 * np.abs(fine).max()


GROUPS = tuple(Group("covariate", f"group {start}", tuple(range(start, start + 2))) for start in range(2, 22, 2))


def data_of(residuals: list[np.ndarray], columns: list[np.ndarray]) -> Whitened:
    return Whitened(
        tuple(residuals),
        tuple(columns),
        np.sum([each.T @ each for each in columns], axis=0),
        np.array([each.T @ own for each, own in zip(columns, residuals, strict=True)]),
    )


def noise(seed: int, runs: int = 40) -> tuple[list[np.ndarray], list[np.ndarray], np.random.Generator]:
    """Heavy-tailed residuals that are correlated within runs, as no noise model says."""
    rng = np.random.default_rng(seed)
    residuals = [rng.standard_t(3, 12) + rng.normal() for _ in range(runs)]
    return residuals, [rng.normal(size=(12, 22)) for _ in range(runs)], rng


def test_noise_of_any_kind_is_surprising_as_often_as_its_p_value_says() -> None:
    seen = []
    for seed in range(200):
        residuals, columns, rng = noise(seed)
        found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
        seen.append(found.p_value(found.best) < 0.1)
    assert binomtest(sum(seen), len(seen), 0.1, alternative="greater").pvalue > 1e-3


def test_an_effect_in_every_run_is_found_in_its_group() -> None:
    residuals, columns, rng = noise(1)
    residuals = [own + each[:, 6] for own, each in zip(residuals, columns, strict=True)]
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.groups[found.best].name == "group 6"
    assert found.p_value(found.best) < 1e-6


def test_one_run_that_went_wrong_is_no_effect() -> None:
    residuals, columns, rng = noise(2)
    residuals[7] = residuals[7] + 40 * columns[7][:, 6]
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.chi_square.max() > 100
    assert found.p_value(found.best) > 0.01


def by_chance(evidence: float, chance: np.ndarray) -> Significance:
    """One group of so much evidence, where random flips made ``chance``."""
    one = np.ones(1)
    return Significance(GROUPS[:1], one, one, one, one, np.array([evidence]), (Family(1, np.sort(chance)),), 0.0, 0)


def test_a_chance_that_many_flips_reach_is_their_share_with_the_data_as_one_more() -> None:
    chance = np.arange(499) / 100
    assert by_chance(4.0, chance).p_value(0) == pytest.approx((99 + 1) / 500)


def test_a_chance_that_hardly_any_flip_reaches_is_that_of_an_exponential_tail() -> None:
    tail = np.concatenate([[1.0], 1.0 + np.linspace(0.0, 1.0, 48)])  # 48 of them beyond the least, by 0.5 in the mean
    chance = np.concatenate([np.zeros(450), tail])
    assert by_chance(3.0, chance).p_value(0) == pytest.approx(49 / 499 * np.exp(-(3 - 1) / 0.5))


def test_what_chance_makes_of_one_family_does_not_hide_another() -> None:
    calm, rough = by_chance(4.0, np.linspace(0, 1, 499)), by_chance(0.5, np.linspace(0, 20, 499))
    both = together(calm, rough)
    assert both.p_value(0) == pytest.approx(2 * calm.p_value(0))  # of two families
    assert both.p_value(1) == min(2 * rough.p_value(0), 1.0)
    assert both.groups == (*calm.groups, *rough.groups)


def test_evidence_is_of_the_difference_without_the_run_that_adds_most_and_corrected_for_its_tries() -> None:
    given = screening({}, {"heading": FIRST, "place": SECOND}, [0, 6, 0, 0, 0])
    groups = [given.groups.bases[0], Group("covariate", "patch", (1,), tries=5)]
    found = significance_of(given.data, [0], groups, np.random.default_rng(0))
    scores = given.data.scores[:, 1]
    least = min((6.0 - score) ** 2 for score in scores)
    assert found.chi_square == pytest.approx([36, 36])
    assert found.evidence == pytest.approx([-chi2.logsf(least, 1) / np.log(10) - each for each in (0, np.log10(5))])


def test_what_chance_makes_is_no_excess() -> None:
    given = screening({}, {"heading": FIRST, "place": SECOND}, [0, 6, 0, 0, 0])
    found = significance_of(given.data, [0], given.groups.bases, np.random.default_rng(0))
    assert found.spread == pytest.approx([1, 1])
    assert found.excess == pytest.approx([35, 0])


def test_the_surplus_is_that_of_the_group_that_stands_out_most_beyond_what_usually_does() -> None:
    given = screening({}, {"heading": FIRST, "place": SECOND, "time": THIRD}, [0, 6, 9, 0, 0])
    found = significance_of(given.data, [0], given.groups.bases, np.random.default_rng(0))
    assert found.surplus_of == 1
    # of three squares of normal numbers the largest is 2.10 in the mean
    assert found.surplus == pytest.approx((81 - 2.10) / np.sqrt(2), abs=0.15)
    assert found.surplus_chi_square == pytest.approx((81 - 2.10, np.sqrt(2)), abs=0.25)


# Fine structure between poses, on sets of the exam that no catalogue has a name for: found, and in the right place.

CHANCE = 0.002


def found_in(fit: fitting.Fit) -> Significance:
    return fine_structure(fit, np.random.default_rng(0))


def found_beside(kind: str, seed: int) -> Significance:
    """Fine structure that the plain matrix leaves in 180 runs with something of a non-centrality of 300."""
    dataset, _ = make_set("outside", kind, 300.0, seed)
    return found_in(plain_fit(dataset))


@pytest.mark.parametrize(
    ("kind", "covariate", "term"),
    [
        ("heading_harmonic", "heading", "smooth_heading_wave"),
        pytest.param("swinging_heading", "elapsed time", "smooth_time_wave", marks=pytest.mark.slow),
        pytest.param("slow_wave", "order of runs", "smooth_session_wave", marks=pytest.mark.slow),
    ],
)
def test_what_happens_within_a_turn_a_run_or_a_session_is_seen_over_it(kind: str, covariate: str, term: str) -> None:
    found = found_beside(kind, 1031)
    basis = found.groups[found.best].basis
    assert (basis.covariate, basis.term) == (covariate, term)
    assert found.p_value(found.best) < CHANCE


@pytest.mark.slow
def test_joints_that_knock_the_robot_round_are_seen_in_the_direction_in_which_they_lie() -> None:
    found = found_beside("tiles", 1022)  # whose joints lie at 84.7 deg
    joints = [index for index, group in enumerate(found.groups) if group.basis and group.basis.term == "smooth_joint"]
    best = max(joints, key=lambda index: found.evidence[index])
    basis = found.groups[best].basis
    assert found.p_value(best) < CHANCE
    assert np.degrees(basis.shapes["normal"]) == pytest.approx(84.7, abs=4)
    assert "turn the robot" in basis.detail


@pytest.mark.slow
def test_a_belt_is_seen_at_the_number_of_times_that_it_turns_with_its_wheel() -> None:
    found = found_beside("belt", 1030)  # which turns half as often
    basis = found.groups[found.best].basis
    assert basis.term == "smooth_wheel_angle"
    assert basis.shapes["harmonic"] == pytest.approx(0.5, abs=0.01)
    assert found.p_value(found.best) < CHANCE


def test_without_absolute_angles_of_the_wheels_none_of_their_waves_are_looked_for() -> None:
    dataset = shorn(simulated(), angles=None)
    groups = found_in(plain_fit(dataset)).groups
    assert not any(group.name == "wheel angle" for group in groups)


@pytest.mark.parametrize("commands", [6, *slow(3, 12)])
def test_where_nothing_is_missing_no_fine_structure_is_surer_than_chance_however_few_runs(commands: int) -> None:
    dataset, _ = make_set("null", "", 0.0, 1003, design="small")
    kept = sorted({run.command or "" for run in dataset.trajectories})[:commands]
    found = found_in(plain_fit(dataset, [run for run in dataset.split("train") if run.command in kept]))
    assert found.p_value(found.best) > CHANCE


def test_few_runs_have_no_fine_structure() -> None:
    dataset = simulated()
    assert fine_structure(plain_fit(dataset, dataset.split("train")[:14]), np.random.default_rng(0)) is None


def test_a_wave_scores_as_its_slopes_do_where_the_tracked_point_is_off_the_robots_centre() -> None:
    dataset = simulated(robot=APR02 | {"mount": {"x": 0.2, "y": -0.1, "yaw": 0.3}})
    fit = plain_fit(dataset)
    found, paths = found_in(fit), fitting.paths_of(fit, 0.0)
    number = next(row for row, group in enumerate(found.groups) if group.name == "heading")  # once a turn
    heading = paths.middle[:, 2]
    shares = np.column_stack([np.cos(heading), np.sin(heading)])
    shares -= shares.mean(axis=0)
    slopes = np.concatenate([paths.respond(changes, shares) for changes in paths.by_modes.values()], axis=2)
    gradient = fit.weighted_residuals
    scores = np.array([np.einsum("ka,kaj->j", of_run, slopes[part]) for of_run, part in
                       zip(gradient, paths.parts, strict=True)])  # fmt: skip
    square = scores.sum(axis=0) @ np.linalg.solve(scores.T @ scores, scores.sum(axis=0))
    assert found.chi_square[number] == pytest.approx(square / (1 - square / len(scores)), rel=0.1)


# Experiments that tell look-alikes apart, and how well they do.

CREEP: Effects = ({"name": "coulomb_creep", "parameters": {"c": 0.022}},)


def proposed(folder: Path) -> FlowerConfig:
    """The config of the experiment that is proposed for the look-alikes."""
    (experiment,) = look_alike().experiments
    (folder / "experiment.yaml").write_text(experiment.config)
    return read_simulation(folder / "experiment.yaml").config


def test_a_proposal_says_what_to_drive_how_long_and_what_it_tells() -> None:
    found = look_alike()
    assert found.verdict == "class"
    (experiment,) = found.experiments
    assert set(experiment.separates) == {"wheel_dead_zone", "coulomb_creep"}
    assert experiment.runs == sum(each.runs for each in experiment.commands) > 1
    driving = sum(each.runs * (each.seconds + 15) for each in experiment.commands) / 60
    assert experiment.minutes == pytest.approx(driving)
    assert experiment.minutes < 10
    assert experiment.chance >= 0.95
    assert experiment.chance_recorded < 0.2
    assert f"Drive {experiment.runs} runs, {experiment.minutes:.1f} minutes" in experiment.description


@pytest.mark.parametrize(
    "truth", [CREEP, pytest.param(DEAD_ZONE, marks=pytest.mark.slow)], ids=lambda truth: truth[0]["name"]
)
def test_whichever_of_the_look_alikes_is_right_is_named_after_the_proposed_runs(truth: Effects, tmp_path: Path) -> None:
    config = proposed(tmp_path).model_dump() | {"truth": {"published": "palacin2023_eq8", "effects": list(truth)}}
    runs = simulate_dataset(FlowerConfig.model_validate(config), "proposed").dataset
    found = discover_effects(joined(simulated(truth, validation=None), [runs]))
    assert found.effects[0].name == truth[0]["name"]
    assert found.effects[0].weight >= 0.95


def test_candidates_are_no_faster_and_steer_no_farther_than_what_was_recorded() -> None:
    fit = steered_half(plain_fit(driven(TRICYCLE)))
    candidates = candidate_runs(fit, [effects.create("heading_drift")], 0.05)
    assert len({candidate.timed.command.speed for candidate in candidates}) > 2
    assert any(candidate.timed.command.turn_rate for candidate in candidates)
    for quantity in ("rates", "steering"):
        done, asked = (
            [np.abs(getattr(run, quantity)).max() for run in runs]
            for runs in (fit.runs, [candidate.runs[0] for candidate in candidates])
        )
        assert max(asked) <= max(done) * 1.0001


def steered_half(fit: fitting.Fit) -> fitting.Fit:
    """The fit at runs that were steered half as far."""
    runs = (run if run.steering is None else replace(run, steering=run.steering / 2) for run in fit.runs)
    return replace(fit, runs=tuple(runs))


def test_headings_matter_only_to_effects_that_depend_on_them() -> None:
    fit = plain_fit(driven(DIFFERENTIAL))
    headings = {
        name: {candidate.runs[0].start[2] for candidate in candidate_runs(fit, [effects.create(name)], 0.05)}
        for name in ("heading_drift", "floor_drift")
    }
    assert len(headings["heading_drift"]) == 1
    assert len(headings["floor_drift"]) == 4


def test_steering_is_turned_within_a_run_where_its_play_is_in_doubt() -> None:
    fit = plain_fit(driven(TRICYCLE))
    steady, weaving = (
        candidate_runs(fit, [effects.create(name)], 0.05)[0].runs[0].steering
        for name in ("heading_drift", "steering_play")
    )
    assert np.ptp(steady) == 0 < np.ptp(weaving)


def test_effects_that_nothing_tells_apart_are_listed_with_all_that_each_looks_like() -> None:
    choice = Choice(np.array([1]), 0.6, 0.0, np.eye(3, dtype=bool))
    said = description_of("abc", 0.5, choice, [("a", "b"), ("a", "c"), ("b", "c")])
    assert said.endswith("surely tells a from b or c; nor b from c.")


# One column that is fitted in any case, and one for each of three effects, which look alike in the recorded runs.
RECORDED = np.array([[4.0, 1.0, 1.0, 1.0], [1.0, 4.0, 3.99, 3.99], [1.0, 3.99, 4.0, 3.99], [1.0, 3.99, 3.99, 4.0]])
VALUES = np.array([0.5, 9.0, 0.0, 0.0])  # the first effect is right
BOTH = np.array([[True, True], [True, True]])


def separation(effects: int = 2) -> Separation:
    """Effects after recorded runs whose scores are as expected of the first."""
    size = 1 + effects
    information = RECORDED[:size, :size]
    recorded = Whitened((), (), information, (information @ VALUES[:size])[None])
    columns = tuple((1 + number,) for number in range(effects))
    prior = np.array([0.0, *np.full(effects, 1 / 900.0)])
    return Separation(recorded, Members((0,), columns, np.ones(effects), prior, np.zeros((size, 1))))


def run_that_shows(*columns: int, size: int = 3, strength: float = 1.0) -> Array:
    """The information of a run in which only these columns show, each by itself."""
    information = np.zeros((size, size))
    information[list(columns), list(columns)] = strength
    return information


def test_the_chance_of_a_sure_name_is_how_often_noise_lets_it_be_sure() -> None:
    further, rng, sure = 0.3 * run_that_shows(1) + 0.2 * run_that_shows(0, 2), np.random.default_rng(1), []
    chance = separation().prospect(further).chances[0, 1]
    posterior = np.linalg.inv(RECORDED[:2, :2] + np.diag([0.0, 1 / 900.0]))
    known = posterior @ (RECORDED[:2, :2] @ VALUES[:2])
    for _ in range(4000):
        values = np.append(rng.multivariate_normal(known, posterior), 0.0)
        noise = np.sqrt(np.diag(further)) * rng.standard_normal(3)
        scores = RECORDED[:3, :3] @ VALUES[:3] + further @ values
        sure.append(odds(RECORDED[:3, :3] + further, scores, noise) > math.log(19))
    assert chance == pytest.approx(np.mean(sure), abs=0.05)


def odds(information: Array, scores: Array, noise: Array) -> float:
    """Log odds of the first effect against the second. noise: of the scores, larger by the discrepancy."""

    def explained(seen: Array) -> Array:
        of = [
            seen[index] @ np.linalg.solve(information[np.ix_(index, index)], seen[index]) for index in ([0, 1], [0, 2])
        ]
        return np.array(of) - seen[0] ** 2 / information[0, 0]

    tempered = 1 + DISCREPANCY**2 * (explained(scores).max() - 1)
    right, wrong = log_evidence(explained(scores + math.sqrt(tempered) * noise) / tempered, np.ones(2))
    return float(right - wrong)


def test_the_fewest_seconds_that_suffice_are_driven() -> None:
    candidates = np.array([run_that_shows(0), run_that_shows(1, strength=0.5), run_that_shows(1, strength=0.4)])
    seconds = np.array([5.0, 20.0, 10.0])
    choice = choose_runs(separation(), candidates, seconds, recorded=20.0)
    assert choice.sure.all()
    assert choice.counts[0] == choice.counts[1] == 0
    needed = [number for number in range(2, 60)
              if separation().prospect(number * candidates[2]).chances.min() >= 0.95]  # fmt: skip
    assert choice.counts[2] == needed[0]


def test_a_pair_that_nothing_separates_is_said_and_the_others_are_separated() -> None:
    candidates = np.array([run_that_shows(0, size=4), run_that_shows(3, size=4)])
    choice = choose_runs(separation(3), candidates, np.array([20.0, 20.0]), recorded=20.0)
    assert choice.sure.tolist() == [[True, False, True], [False, True, True], [True, True, True]]
    assert choice.counts[1] >= 2


def test_where_nothing_separates_any_pair_nothing_is_driven() -> None:
    choice = choose_runs(separation(), np.array([run_that_shows(0)]), np.array([20.0]), recorded=20.0)
    assert not choice.counts.any()
