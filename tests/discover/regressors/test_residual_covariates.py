"""The pictures of residuals: they show what was hidden, and nothing where nothing was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import DELAY, ECCENTRICITY, lagging, named, nothing, simulated
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from omnibench.discover.discover import discover_effects
from omnibench.discover.report.residuals import EXTENDED, NORMAL_95, PLAIN, Panel, Residuals, shares
from omnibench.discover.report.where_section import motor_grid


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


def test_the_other_wheels_show_nothing(eccentric: Residuals) -> None:
    for wheel in (1, 2):
        values, errors = rate_errors(eccentric, wheel, 1)
        assert (np.abs(values) < 4 * errors).all()


def test_a_late_reference_shows_its_delay_in_every_run(eccentric: Residuals) -> None:
    paths = eccentric.paths
    velocity = np.concatenate(
        [
            np.column_stack(
                [
                    (np.interp(log.stamps + 0.05, [0, *log.times], path[:, axis])
                     - np.interp(log.stamps - 0.05, [0, *log.times], path[:, axis])) / 0.1
                    for axis in range(3)
                ]
            )
            for log, path in zip(paths.logs, paths.ends, strict=True)
        ]
    )  # fmt: skip
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
    dataset = replace(
        found.dataset,
        trajectories=tuple(
            replace(run, poses=moved(run.poses, moves[run.id])) for run in found.dataset.trajectories if run.id in moves
        ),
    )
    before = tuple(
        moved(own, np.array([0.0, 0.0, moves[name][2]]), turn=False)
        for name, own in zip(found.trajectories, found.before, strict=True)
    )
    here, there = Residuals(found).commands, Residuals(replace(found, dataset=dataset, before=before)).commands
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(other.end, one.end, atol=1e-9)
        np.testing.assert_allclose(other.means[0], one.means[0], atol=1e-9)


def moved(poses: np.ndarray, move: np.ndarray, turn: bool = True) -> np.ndarray:
    """Poses (K, 3) turned about the origin and then shifted; turn: their headings, too."""
    x, y, angle = move
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.column_stack(
        [
            x + cosine * poses[:, 0] - sine * poses[:, 1],
            y + sine * poses[:, 0] + cosine * poses[:, 1],
            poses[:, 2] + (angle if turn else 0.0),
        ]
    )


def test_what_depends_on_the_command_does_not_stand_out_over_the_wheel_angle() -> None:
    residuals = Residuals(named())
    outside = [
        np.abs(values) > NORMAL_95 * errors
        for wheel in range(3)
        for harmonic in range(1, 9)
        for values, errors in [rate_errors(residuals, wheel, harmonic)]
    ]
    assert np.mean(np.array(outside)[..., PLAIN.index]) < 0.15


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


def test_shares_put_every_value_in_one_bin_and_those_outside_in_none() -> None:
    found = shares(np.array([-0.1, 0.0, 0.5, 1.0, 1.1]), [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(found, [[0, 0], [1, 0], [0, 1], [0, 1], [0, 0]])


def test_a_panel_without_any_known_value_is_empty() -> None:
    assert Panel("", np.zeros(1), (), "", "", "").empty


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


def test_targets_that_are_copies_of_the_rates_are_not_drawn() -> None:
    found = nothing()
    runs = [replace(run, targets=run.rates) for run in Residuals(found).runs]
    assert motor_grid(found, runs) is None


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
