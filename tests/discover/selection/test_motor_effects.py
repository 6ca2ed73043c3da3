"""Effects of the motors, from a few runs whose wheel rates follow their targets in a way that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import APR02

from omnibench.data.dataset import Trajectory
from omnibench.discover.selection.motor_effects import MotorEffects, select_motor_effects
from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect
from omnibench.robot.kinematics import Robot

ROBOT = Robot.model_validate(APR02)
NOISE = 1e-3  # rad/s, of each measured rate


def runs(name: str = "motor_gain", count: int = 12, **values: float) -> list[Trajectory]:
    """Runs of three commands, each wheel at its own two speeds in turn, both ways; driven by one effect."""
    rng = np.random.default_rng(1)
    times = np.arange(1, 81) / 20
    effect = effects.create(name)
    assert isinstance(effect, ActuatorEffect)
    made = []
    for number in range(count):
        speeds = (0.5 + number % 3) * np.array([1.0, -0.6, 0.3])
        targets = np.sign(np.sin(np.pi * times + 0.1))[:, None] * speeds
        rates = effect.driven(np.diff(times, prepend=0.0), targets, values)
        rates = rates + NOISE * rng.standard_normal(rates.shape)
        still = np.zeros((1, 3))
        made.append(
            Trajectory(f"run {number}", "train", times, rates, np.zeros(1), still, f"{number % 3}", targets=targets)
        )
    return made


def found(recorded: list[Trajectory], *without: str) -> MotorEffects | None:
    return select_motor_effects(recorded, ROBOT, without, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("name", "values"),
    [("motor_gain", {"g": -0.03}), ("motor_lag", {"tau": 0.08}), ("motor_dead_band", {"band": 0.05})],
)
def test_an_effect_is_named_and_its_parameter_is_exact_to_its_standard_error(
    name: str, values: dict[str, float]
) -> None:
    motors = found(runs(name, **values))
    assert motors is not None
    assert [group.name for group in motors.selection.chosen] == [name]
    error = motors.covariance.standard_deviations[0]
    assert motors.values[0] == pytest.approx(*values.values(), abs=4 * error)
    assert error < 0.02 * abs(next(iter(values.values())))


def test_the_standard_error_of_a_gain_is_that_of_a_regression_on_the_targets() -> None:
    recorded = runs(g=-0.03, count=60)
    motors = found(recorded)
    assert motors is not None
    squares = sum(float(np.square(run.targets).sum()) for run in recorded if run.targets is not None)
    assert motors.covariance.standard_deviations[0] == pytest.approx(NOISE / np.sqrt(squares), rel=0.5)


def test_of_motors_that_only_scatter_nothing_is_named() -> None:
    motors = found(runs(g=0.0))
    assert motors is not None
    assert motors.selection.chosen == ()
    assert motors.values.shape == (0,)


def test_an_effect_that_is_left_out_is_not_named() -> None:
    motors = found(runs(g=-0.03), "motor_gain")
    assert motors is not None
    assert "motor_gain" not in motors.selection.weights


def test_without_targets_there_is_nothing_to_say() -> None:
    assert found([replace(run, targets=None) for run in runs(g=-0.03)]) is None


def test_targets_that_are_copies_of_the_rates_or_were_never_filled_say_nothing() -> None:
    recorded = runs(g=-0.03)
    assert found([replace(run, targets=run.rates) for run in recorded]) is None
    assert found([replace(run, targets=np.zeros_like(run.rates)) for run in recorded]) is None
