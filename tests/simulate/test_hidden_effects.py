"""Effects that are hidden in simulated recordings, ramps and random starts; and what was simulated before stays."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from config_robots import QUIET, apr02
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.evaluate import final_errors
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.kinematics import moved_to, published_matrix, wheel_equations
from omnibench.simulate.commands import Command
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.flower import commanded_rates
from omnibench.simulate.simulate import simulate_dataset

PUBLISHED = "palacin2023_eq8"
BENCHMARK = [540843.680886297, 18067279.735240657, 11605.562333690346]  # rad/s, rad, m and rad


def few(effects: Mapping[str, Mapping[str, float]] | None = None, **changes: Any) -> FlowerConfig:
    """Six short runs without noise, in the order of the commands, by a robot with these effects."""
    hidden = [{"name": name, "parameters": dict(values)} for name, values in (effects or {}).items()]
    commands = {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.35]}
    plain = {
        "truth": {"published": PUBLISHED, "effects": hidden},
        "commands": commands | changes.pop("commands", {}),
        "repetitions": 1,
        "order": "sorted",
        "noise": QUIET,
        "train": {"seed": 1, "distance": 0.6},
        "validation": None,
    }
    return apr02(**(plain | changes))


def runs(effects: Mapping[str, Mapping[str, float]] | None = None, **changes: Any) -> tuple[Trajectory, ...]:
    return simulate_dataset(few(effects, **changes)).dataset.trajectories


def test_the_benchmark_stays_what_it_was() -> None:
    """Sums over its 360 runs, by the version that drew noise as the published comparisons have it."""
    runs = simulate_dataset(apr02()).dataset.trajectories
    drawn = [sum(float(np.abs(getattr(run, name)).sum()) for run in runs) for name in ("rates", "angles", "poses")]
    assert drawn == pytest.approx(BENCHMARK, rel=1e-12)


class TestEffects:
    def test_motors_with_a_wrong_gain_turn_wheels_by_as_much_faster(self) -> None:
        for run in runs({"motor_gain": {"g": 0.04}}):
            np.testing.assert_allclose(run.rates, 1.04 * run.targets, rtol=1e-12)

    def test_what_motors_lag_behind_is_seen_by_encoders_and_reference(self) -> None:
        for lagging, plain in zip(runs({"motor_lag": {"tau": 0.2}}), runs(), strict=True):
            missing = (plain.rates - lagging.rates).sum(axis=0) * 0.01
            np.testing.assert_allclose(missing, 0.2 * plain.rates[0], rtol=1e-5)
            turned = published_matrix(PUBLISHED)[2] @ missing
            assert plain.poses[-1, 2] - lagging.poses[-1, 2] == pytest.approx(turned, rel=1e-6)

    @pytest.mark.parametrize(
        "effects",
        [
            {"wheel_eccentricity": {"a_a": 0.02, "b_c": -0.01}},
            {"acceleration_slip": {"k": 0.05}, "heading_latency": {"tau": 0.05}},
            {"floor_drift": {"dx": 0.02, "dy": -0.01}, "thermal_radius_drift": {"k": 1e-5}},
            {"start_transient": {"k": 0.2, "length": 0.1}, "lidar_lever_arm": {"x": 0.05, "y": 0.02}},
            {"motor_lag": {"tau": 0.1}, "tyre_wear": {"radius_validation": 0.01}},
            {"heading_drift": {"b": 0.01}, "reference_time_offset": {"tau": 0.1}},
        ],
    )
    def test_without_noise_the_recording_is_what_the_true_model_reports(self, effects: dict[str, Any]) -> None:
        shape = {"start": "random", "commands": {"ramp": 0.3}, "validation": {"seed": 2, "distance": 0.5}}
        made = simulate_dataset(few(effects, **shape))
        model = made.truth.true_robot().model
        assert {term.name for term in model.terms} == set(effects)
        found = model.reported([run.reference_log for run in made.dataset.trajectories])
        for run, poses in zip(made.dataset.trajectories, found, strict=True):
            np.testing.assert_allclose(run.poses[1:], poses, atol=1e-12)

    def test_encoder_noise_does_not_move_the_wheels_away_from_their_recorded_angles(self) -> None:
        noisy = {"noise": QUIET | {"encoder": 0.02}, "repetitions": 20}
        errors = []
        for effects in ({"wheel_eccentricity": {"a_a": 0.02}}, {}):
            made = simulate_dataset(few(effects, **noisy))
            errors.append(final_errors(made.truth.true_robot().model, made.dataset.trajectories))
        assert np.abs(errors[1]).max() > 1e-3  # what the noise itself does
        assert np.abs(errors[0] - errors[1]).max() < 5e-5

    def test_what_is_hidden_is_in_the_truth_with_all_its_parameters_and_not_in_the_data(self) -> None:
        made = simulate_dataset(few({"wheel_eccentricity": {"a_b": 0.02}}))
        zeros = dict.fromkeys(("a_a", "b_a", "a_b", "b_b", "a_c", "b_c"), 0.0)
        assert made.truth.effects == (EffectTerm(name="wheel_eccentricity", parameters=zeros | {"a_b": 0.02}),)
        said = (made.dataset.name, made.dataset.description, made.dataset.source, *made.dataset.warnings)
        assert not any("eccentric" in text for text in said)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown effect": ({"heading_drft": {"b": 0.1}}, "'heading_drift'"),
    "an unknown parameter": ({"heading_drift": {"bb": 0.1}}, "'bb'"),
    "a wheel that is not there": ({"wheel_eccentricity": {"a_d": 0.1}}, "'a_d'"),
    "a session that is not driven": ({"tyre_wear": {"radius_validation": 0.01}}, "'radius_validation'"),
    "no parameter": ({"heading_drift": {}}, "'b' (rad/s)"),
    "no shape": ({"start_transient": {"k": 0.1}}, "'length' (m)"),
    "a shape out of range": ({"start_transient": {"k": 0.1, "length": 99}}, "'length' is 99"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_an_effect_that_cannot_be_hidden_is_refused_in_one_line(case: str) -> None:
    effects, words = REFUSED[case]
    with pytest.raises(OmnibenchError, match=f"truth.effects: .*{re.escape(words)}") as refusal:
        simulate_dataset(few(effects))
    assert "\n" not in str(refusal.value)


TERM = {"name": "heading_drift", "parameters": {"b": 0.1}}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"truth": {"published": PUBLISHED, "effects": [TERM, TERM]}}, "heading_drift"),
        ({"commands": {"ramp": 3.5}}, "commands.ramp: 3.5 s; .* 3 s"),
        ({"commands": {"ramp": 1.5, "speeds": [0.0, 0.2], "turn_duration": 1.0}}, "1 s"),
        ({"commands": {"ramp": -1}}, "commands.ramp"),
        ({"start": "anywhere"}, "start"),
        ({"start": "random", "start_area": 0}, "start"),
    ],
)
def test_effects_given_twice_ramps_longer_than_a_run_and_unknown_starts_are_refused(changes: Any, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        few(**changes)


class TestRamps:
    def test_wheels_rise_linearly_to_their_speed_take_longer_and_keep_their_way(self) -> None:
        for run, plain in zip(runs(commands={"ramp": 0.5}), runs(), strict=True):
            full = plain.rates[0]
            np.testing.assert_allclose(run.rates[0], 0.01 * full, rtol=1e-9)  # mean of the first of 50 samples
            np.testing.assert_allclose(run.rates[-1], 0.01 * full, rtol=1e-9)
            np.testing.assert_allclose(run.rates[50:-50], np.tile(full, (len(run.rates) - 100, 1)), rtol=1e-9)
            steps = np.diff(run.rates[:50], axis=0)
            np.testing.assert_allclose(steps, np.tile(steps[0], (49, 1)), rtol=1e-6)
            assert run.times[-1] == pytest.approx(plain.times[-1] + 0.5)
            np.testing.assert_allclose((run.rates * 0.01).sum(axis=0), (plain.rates * 0.01).sum(axis=0), rtol=1e-9)
            assert (run.distance, run.duration) == (pytest.approx(0.6), run.times[-1])

    def test_turns_on_the_spot_are_ramped_too(self) -> None:
        commands = {"speeds": [0.0], "turn_duration": 2.0, "ramp": 1.0}
        for run in runs(commands=commands):
            assert run.times[-1] == pytest.approx(3.0)
            assert abs(run.omega or 0) == 0.35
            heading = published_matrix(PUBLISHED)[2] @ wheel_equations(few().robot.wheels)[:, 2] * (run.omega or 0) * 2
            assert run.poses[-1, 2] == pytest.approx(heading)

    @given(st.floats(0.05, 2.0), st.floats(0.5, 5.0), st.lists(st.floats(1e-3, 0.3), min_size=1, max_size=40))
    def test_samples_of_any_length_add_up_to_the_same_way(self, ramp: float, full: float, lengths: list[float]) -> None:
        end = 2 * ramp + full
        times = np.append(np.cumsum(lengths)[np.cumsum(lengths) < end - 1e-3], end)
        robot = few().robot
        command = Command(0.2, 0.3, 0.1)
        rates = commanded_rates(robot, command, times, ramp)
        driven = (rates * np.diff(times, prepend=0.0)[:, None]).sum(axis=0)
        np.testing.assert_allclose(driven, (full + ramp) * wheel_equations(robot.wheels) @ command.twist, rtol=1e-9)


class TestRandomStarts:
    def test_starts_lie_anywhere_in_the_square_with_any_heading(self) -> None:
        starts = np.array([run.start for run in runs(repetitions=60, start="random", start_area=3.0)])
        assert np.abs(starts[:, :2]).max() <= 1.5
        assert (np.abs(starts[:, :2]).max(axis=0) > 1.4).all()
        assert [starts[:, 2].min(), starts[:, 2].max()] == pytest.approx([-math.pi, math.pi], abs=0.15)

    def test_a_run_is_the_same_from_wherever_it_starts(self) -> None:
        for moved, plain in zip(runs(start="random"), runs(), strict=True):
            np.testing.assert_allclose(moved.poses, moved_to(moved.start, plain.poses), atol=1e-9)

    def test_starts_are_those_of_the_seed(self) -> None:
        again = [
            simulate_dataset(few(start="random", train={"seed": seed, "distance": 0.6})).dataset for seed in (1, 1, 2)
        ]
        assert again[0].hash == again[1].hash != again[2].hash


def test_a_record_of_the_truth_says_what_it_lacks() -> None:
    truth = simulate_dataset(few()).truth
    broken = truth.model_copy(update={"effects": (EffectTerm(name="heading_drift"),)})
    with pytest.raises(DataError, match=r"data set flower: truth.effects: effect 'heading_drift': parameter 'b'"):
        broken.true_robot()
