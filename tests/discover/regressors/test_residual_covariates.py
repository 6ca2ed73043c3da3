"""What residuals depend on: slopes along paths, covariates and their significance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from config_robots import NAMES as NAMES_OF_ROBOTS
from config_robots import settings as settings_of
from discovery_samples import DELAY, ECCENTRICITY, lagging, nothing, plain_fit, simulated
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recording_samples import in_room
from scipy.stats import binomtest, chi2
from screening_samples import FIRST, SECOND, THIRD, screening

from omnibench.config import validate
from omnibench.discover.discover import discover_effects
from omnibench.discover.fitting import Fit, paths_of
from omnibench.discover.regressors.paths import slopes_by
from omnibench.discover.regressors.significance import Family, Group, Significance, significance_of, together
from omnibench.discover.report.residuals import EXTENDED, NORMAL_95, PLAIN, Residuals, shares
from omnibench.discover.report.where_section import motor_grid
from omnibench.fit.trajectory_fit import Whitened, usable_runs
from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect, make_term
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset


@pytest.fixture(scope="module")
def eccentric() -> Residuals:
    """Residuals of a robot with an eccentric wheel a and a late reference."""
    return Residuals(discover_effects(simulated(ECCENTRICITY + DELAY)))


def rate_errors(residuals: Residuals, wheel: int, harmonic: float) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes of cosine and sine (2, before and after) in a wheel's rate, and their errors."""
    paths = residuals.paths
    angle, rate = paths.signals.wheel_angles[:, wheel], paths.signals.rates[:, wheel]
    columns = np.column_stack([rate * np.cos(harmonic * angle), rate * np.sin(harmonic * angle)])
    fitted = residuals.fit(paths.of_wheel(wheel, columns))
    return fitted.values, fitted.errors


def test_an_eccentric_wheel_shows_its_amplitude_before_and_nothing_after(eccentric: Residuals) -> None:
    values, errors = rate_errors(eccentric, 0, 1)
    noise = errors[0, EXTENDED.index]
    assert 0.012 < values[0, PLAIN.index] < 0.022  # some of 0.02 is in the matrix, and in the start headings
    assert abs(values[1, PLAIN.index]) < 4 * errors[1, PLAIN.index]
    assert np.abs(values[:, EXTENDED.index]).max() < 4 * noise


def test_a_late_reference_shows_its_delay_in_every_run(eccentric: Residuals) -> None:
    paths = eccentric.paths

    def seen(log: WheelLog, path: np.ndarray, later: float) -> np.ndarray:
        return np.column_stack([np.interp(log.stamps + later, [0, *log.times], axis) for axis in path.T])

    ways = zip(paths.logs, paths.ends, strict=True)
    velocity = np.concatenate([(seen(log, path, 0.05) - seen(log, path, -0.05)) / 0.1 for log, path in ways])
    fitted = eccentric.fit_runs(-velocity[:, :, None])
    assert (fitted.values[:, PLAIN.index] > 0).mean() > 0.9
    assert np.median(fitted.values[:, PLAIN.index]) > 0.01  # of 0.06: the matrix takes up much
    assert abs(np.median(fitted.values[:, EXTENDED.index])) < 0.005


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
        np.testing.assert_allclose(other.end, one.end, atol=1e-9)
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
    assert drawn is not None
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
    np.testing.assert_allclose(fitted.values[:, PLAIN.index], values, atol=1e-9)


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


def on_robot(robot: str) -> Fit:
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
def fitted() -> Fit:
    return on_robot("three")


@pytest.mark.parametrize("robot", ["three", *NAMES_OF_ROBOTS])
def test_slopes_by_an_effect_are_the_models_own(robot: str) -> None:
    fit = on_robot(robot)
    applied = [name for name in NAMES if effects.create(name).applies(fit.model.robot)]
    for name in applied:
        check_slopes(fit, name)


@pytest.mark.parametrize("name", NAMELESS)
def test_slopes_by_an_effect_without_a_name_are_the_models_own(fitted: Fit, name: str) -> None:
    check_slopes(fitted, name)


def check_slopes(fitted: Fit, name: str) -> None:
    paths = paths_of(fitted)
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


def test_samples_put_together_give_the_same_slopes_of_what_varies_slowly(fitted: Fit) -> None:
    effect = effects.create("heading_drift")
    fine, coarse = (slopes_by(paths_of(fitted, together), effect, ["b"], {"b": 0.0}) for together in (0.0, 0.12))
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


def test_the_scale_of_the_tail_is_right_in_the_mean() -> None:
    rng = np.random.default_rng(3)
    drawn = np.sort(rng.exponential(size=(2000, 499)), axis=1)
    told = np.array(
        [-np.log(by_chance(edge + 20.0, chance).p_value(0) * 499 / 49) for chance in drawn if (edge := chance[-49])]
    )
    assert np.mean(20.0 / told) == pytest.approx(1.0, abs=0.01)  # the scale of these exponentials; its error is 0.003


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
