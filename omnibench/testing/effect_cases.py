"""Conformance cases for effects."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import Any, get_args
from unittest import SkipTest

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect, MotionEffect, Need, Parameter, ReferenceEffect
from omnibench.robot.kinematics import Robot
from omnibench.robot.signals import Signals
from omnibench.testing.conformance import Conformance, global_random_fingerprint, global_random_state, require
from omnibench.testing.effect_inputs import (
    SAMPLES,
    SESSIONS,
    Input,
    arrays,
    changes,
    driven_signals,
    motor_input,
    one_row,
    results,
    robots,
    trial_input,
    trial_poses,
    trial_values,
    trials,
    without,
)
from omnibench.testing.synthetic import synthetic_robots

_KINDS = {
    "MotionEffect": (MotionEffect, ("wheel", "steering", "clock", "body", "world")),
    "ReferenceEffect": (ReferenceEffect, ("reference",)),
    "ActuatorEffect": (ActuatorEffect, ("actuator",)),
}
_OPTIONAL = {"wheel_angles", "session_time", "session", "poses", "steering_side", "caster_rates"}
_ROUNDING = 1e-9  # relative to the largest value
_NOTHING = 1e-12  # m, rad, rad/s: a smaller change is rounding


class EffectConformance(Conformance):
    """Requirements on every effect. Cases for another kind of effect are skipped."""

    registry = effects

    def test_physics_and_source_are_given(self) -> None:
        """Reports print them beside the name."""
        effect = self.make()
        for item in ("physics", "source", "shows_in"):
            text = getattr(effect, item, "")
            require(isinstance(text, str) and bool(text.strip()), f"{item} is missing; set it in the class")

    def test_stage_is_one_of_its_kind(self) -> None:
        """A MotionEffect acts on wheels, steering, clock, body or world."""
        effect = self.make()
        kinds = [name for name, (kind, _) in _KINDS.items() if isinstance(effect, kind)]
        require(len(kinds) == 1, f"it must derive from one of {', '.join(_KINDS)}")
        _, stages = _KINDS[kinds[0]]
        stage = getattr(effect, "stage", None)
        require(stage in stages, f"stage is {stage!r}; of a {kinds[0]} it is one of {', '.join(stages)}")

    def test_it_applies_to_robots_that_it_names(self) -> None:
        """It applies to one of the trial robots, and says for which it is where it does not apply to all."""
        effect = self.make()
        require(bool(robots(effect)), "applies is False for robots on omni, mecanum, fixed and steered wheels")
        everywhere = all(effect.applies(robot) for robot in synthetic_robots())
        require(everywhere or bool(effect.only_for), "only_for is missing: say in words to which robots it applies")

    def test_needs_are_known(self) -> None:
        """``needs`` holds names of the contract only."""
        unknown = set(self.make().needs) - set(get_args(Need))
        require(not unknown, f"needs holds {sorted(map(str, unknown))}; known are {', '.join(get_args(Need))}")

    def test_parameters_have_units_and_plausible_ranges(self) -> None:
        """Every parameter has a unit, a description and a finite range."""
        for robot in robots(self.make()):
            parameters = self.make().parameters(robot, SESSIONS)
            valid = isinstance(parameters, tuple) and all(isinstance(item, Parameter) for item in parameters)
            require(valid, "parameters must give a tuple of Parameter")
            require(
                any(not item.choices for item in parameters), "it needs a parameter without choices, 0 for no effect"
            )
            for parameter in parameters:
                _check_parameter(parameter)

    def test_parameters_have_names_of_their_own(self) -> None:
        """Names are keys of the calibration file: unique, and the same in every call."""
        for robot in robots(self.make()):
            first, again = (self.make().parameters(robot, SESSIONS) for _ in range(2))
            names = [each.name for each in first]
            require(len(set(names)) == len(names), f"two parameters have one name: {', '.join(names)}")
            require(first == again, "parameters gives other parameters in a second call")

    def test_shapes_are_those_of_the_contract(self) -> None:
        """Results have the right shape for one sample and many, three wheels and four."""
        effect = self.make()
        for (robot, values), samples in product(trials(effect), (1, SAMPLES)):
            given = trial_input(effect, robot, samples=samples)
            for name, result in results(effect, given, values).items():
                shape, expected = np.shape(result), _shape(name, effect.stage, given, robot)
                require(shape == expected, f"{name} has shape {shape}, expected {expected}")

    def test_zero_parameters_change_nothing(self) -> None:
        """An effect whose parameters are 0 changes nothing."""
        effect = self.make()
        for robot, values in trials(effect):
            given = trial_input(effect, robot)
            largest = float(np.abs(changes(effect, given, without(effect, robot, values))).max())
            require(largest <= _NOTHING, f"parameters of 0 change something, by {largest:.3g}")

    def test_parameters_change_something(self) -> None:
        """It changes something in a varied drive."""
        effect = self.make()
        for robot in robots(effect):
            given = trial_input(effect, robot)
            seen = any((np.abs(changes(effect, given, each)) > 0).any() for each in trial_values(effect, robot))
            require(seen, f"no parameters change anything on {len(robot.wheel_names)} wheels")

    def test_results_are_finite(self) -> None:
        """Results are finite while the robot drives, drives fast and stands."""
        effect = self.make()
        for (robot, values), speed in product(trials(effect), (0.0, 1.0, 20.0)):
            finite = np.isfinite(changes(effect, trial_input(effect, robot, speed), values)).all()
            require(bool(finite), f"a result is not finite where the robot {'drives' if speed else 'stands'}")

    def test_it_is_linear_in_its_parameters(self) -> None:
        """Fits and ``discover`` rely on it; parameters with choices are exempt."""
        effect = self.make()
        if isinstance(effect, ActuatorEffect):
            raise SkipTest("only for effects that are fitted")
        # reported poses need be linear for small parameters only: rotations are not linear in their angle
        size, tolerance = (1.0, _ROUNDING) if isinstance(effect, MotionEffect) else (1e-5, 1e-3)
        for robot in robots(effect):
            given = trial_input(effect, robot)
            for first, second in zip(trial_values(effect, robot, 1), trial_values(effect, robot, 2), strict=True):
                free = [name for name in first if first[name] != second[name]]
                one, other = (dict(values) | {name: size * values[name] for name in free} for values in (first, second))
                both = one | {name: one[name] - 2 * other[name] for name in free}
                of_one, of_other, of_both = (changes(effect, given, values) for values in (one, other, both))
                error = float(np.abs(of_both - (of_one - 2 * of_other)).max())
                scale = float(max(np.abs(of_one).max(), np.abs(of_other).max()))
                require(error <= tolerance * scale, f"it is not linear in its parameters: off by {error:.3g}")

    def test_inputs_are_left_unchanged(self) -> None:
        """Signals, poses and values are not overwritten."""
        effect = self.make()
        for robot, values in trials(effect):
            given = trial_input(effect, robot)
            before, kept = {name: array.copy() for name, array in arrays(given).items()}, dict(values)
            results(effect, given, values)
            same = all(np.array_equal(array, before[name]) for name, array in arrays(given).items())
            require(same and values == kept, "it changed its arguments; work on copies")

    def test_each_sample_is_corrected_by_itself(self) -> None:
        """A sample is corrected the same alone, as in a stream, and in a batch."""
        effect = self.make()
        for robot, values in trials(effect):
            given = trial_input(effect, robot)
            if not isinstance(given, Signals) and len(given) == 2:
                raise SkipTest("only for effects that act in a stream")
            together = changes(effect, given, values)
            for row in (0, 7, SAMPLES - 1, 3):
                alone = changes(effect, one_row(given, row), values)
                same = len(alone) == 1 and np.allclose(alone[0], together[row], rtol=1e-9, atol=_NOTHING)
                require(same, f"row {row} differs between a batch and a stream; it must not depend on other samples")

    def test_results_are_reproducible(self) -> None:
        """Results are equal in every call and instance, and no global random generator is used."""
        for robot, values in trials(self.make()):
            given = trial_input(self.make(), robot)
            repeated = []
            for seed in (1, 2):
                with global_random_state(seed):
                    before = global_random_fingerprint()
                    effect = self.make()
                    repeated += [changes(effect, given, values) for _ in range(2)]
                    require(global_random_fingerprint() == before, "it draws random numbers")
            same = all(np.array_equal(repeated[0], result) for result in repeated[1:])
            require(same, "its results differ from call to call")

    def test_needs_names_all_that_is_used(self) -> None:
        """It works on recordings that lack everything which ``needs`` does not name."""
        effect = self.make()
        if not isinstance(effect, MotionEffect):
            raise SkipTest("only for effects of motion")
        unused = _OPTIONAL - set(effect.needs)
        bare: dict[str, Any] = dict.fromkeys(unused)
        for robot, values in trials(effect):
            try:
                results(effect, replace(driven_signals(robot), **bare), values)
            except (TypeError, AttributeError) as error:
                missing = ", ".join(sorted(unused))
                require(False, f"without {missing} it raises {type(error).__name__}: {error}; name it in needs")

    def test_corrected_poses_are_the_true_ones(self) -> None:
        """``corrected`` is the inverse of ``reported``."""
        effect = self.make()
        if not isinstance(effect, ReferenceEffect):
            raise SkipTest("only for effects of the reference")
        poses = trial_poses()
        for _, values in trials(effect):
            back = effect.corrected(effect.reported(poses, poses[0], values), poses[0], values)
            error = float(np.abs(back - poses).max())
            require(error <= _ROUNDING, f"corrected(reported(poses)) is off by {error:.3g}")

    def test_motors_are_causal(self) -> None:
        """Wheel rates depend on earlier targets only, and are 0 until the first target."""
        effect = self.make()
        if not isinstance(effect, ActuatorEffect):
            raise SkipTest("only for effects of the motors")
        for robot, values in trials(effect):
            durations, targets = motor_input(robot)
            early = effect.driven(durations[:50], targets[:50], values)
            same = np.allclose(early, effect.driven(durations, targets, values)[:50], rtol=1e-9, atol=_NOTHING)
            require(same, "later targets change earlier wheel rates")
            still = effect.driven(durations, np.zeros_like(targets), values)
            require(not np.any(still), "the wheels turn though all targets are 0")


def _check_parameter(parameter: Parameter) -> None:
    """Nonconformance unless name, unit, description and range are valid."""
    place = f"parameter {parameter.name!r}"
    low, high = parameter.low, parameter.high
    require(bool(parameter.name) and parameter.name.isprintable(), f"{place}: its name is empty, or cannot be printed")
    require(bool(parameter.unit.strip()), f"{place} has no unit; that of a ratio is 1")
    require(bool(parameter.description.strip()), f"{place} has no description")
    require(math.isfinite(low) and math.isfinite(high), f"{place}: its range is not finite")
    require(low < high, f"{place}: low {low:g} is not below high {high:g}")
    if parameter.choices:
        inside = all(low <= each <= high for each in parameter.choices)
        require(inside, f"{place}: a choice is not within {low:g} and {high:g}")
    else:
        require(low <= 0 <= high, f"{place}: 0, where it does not act, is not within {low:g} and {high:g}")


def _shape(result: str, stage: str, given: Input, robot: Robot) -> tuple[int, ...]:
    """The shape that the contract gives to a result."""
    if isinstance(given, Signals):
        widths = {"body": 3, "world": 2, "steering": len(robot.drive.steered)}
        return len(given.durations), widths.get(stage, len(robot.wheel_names))
    return given[0].shape if result.startswith("delays") else given[1].shape
