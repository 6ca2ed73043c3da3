"""Conformance cases for effects."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any, Final, get_args
from unittest import SkipTest

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects import effect as contract
from omnibench.robot.kinematics import Array, Robot, in_the_middle
from omnibench.robot.signals import Caster, Signals, SteeringGears, SteeringServos
from omnibench.testing.cases import Conformance, global_random_fingerprint, global_random_state, require
from omnibench.testing.synthetic import synthetic_robot, synthetic_robots

PERIOD: Final = 0.01  # s, of the wheel samples
SAMPLES: Final = 200
SESSIONS: Final = ("morning", "evening")
_KINDS = {
    "MotionEffect": (contract.MotionEffect, ("wheel", "steering", "clock", "body", "world")),
    "ReferenceEffect": (contract.ReferenceEffect, ("reference",)),
    "ActuatorEffect": (contract.ActuatorEffect, ("actuator",)),
}
_OPTIONAL = {"wheel_angles", "session_time", "session", "poses", "steering_side", "servo_gaps", "caster_rates"}
_ROUNDING = 1e-9  # relative to the largest value
_NOTHING = 1e-12  # m, rad, rad/s: a smaller change is rounding
_OMNI: Final = frozenset({synthetic_robot(3).name, synthetic_robot(4).name})
Poses = tuple[Array, Array, Array]  # stamps (K,), poses (K, 3), start (3,)
Motors = tuple[Array, Array]  # durations (F,), targets (F, N)
Input = Signals | Poses | Motors


def driven_signals(robot: Robot, samples: int = SAMPLES, speed: float = 1.0) -> Signals:
    """Signals (F = samples) of a varied drive with rates of about 5 ``speed`` rad/s; speed 0: the robot stands."""
    rng = np.random.default_rng(0)
    ends = PERIOD * np.arange(1, samples + 1)
    phases = rng.uniform(0, 2 * math.pi, (2, len(robot.wheel_names)))
    rates = 5 * speed * (np.sin(2 * ends[:, None] + phases[0]) + 0.3 * np.sin(9 * ends[:, None] + phases[1]))
    swings = 0.4 * speed * np.sin(3 * ends[:, None] + np.arange(len(robot.drive.steered)))  # rad
    steering = in_the_middle(swings) if robot.drive.steered else None
    gears, servos, caster = SteeringGears(), SteeringServos(), Caster(robot)
    twists = robot.drive.signals(rates, steering) @ robot.inverse_kinematic_matrix.T
    middle = ends - PERIOD / 2
    # Headings of the twists, positions on a loop beside the origin.
    headings = 0.3 + PERIOD * np.cumsum(twists[:, 2])
    poses = np.column_stack([0.5 + 0.8 * np.sin(middle), -0.4 + 0.8 * np.cos(1.3 * middle), headings])
    return Signals(
        robot=robot,
        durations=np.full(samples, PERIOD),
        rates=rates,
        elapsed=middle,
        twists=twists,
        accelerations=np.diff(twists, axis=0, prepend=0.0) / PERIOD,
        travelled=np.cumsum(np.hypot(twists[:, 0], twists[:, 1])) * PERIOD,
        wheel_angles=3.0 + np.cumsum(rates, axis=0) * PERIOD,
        session_time=600.0 + middle,
        session=SESSIONS[1],
        poses=poses,
        steering=steering,
        steering_rates=None if steering is None else np.diff(swings, axis=0, prepend=swings[:1]) / PERIOD,
        steering_side=None if steering is None else np.array([gears.turned(angles) for angles in steering]),
        servo_gaps=None
        if steering is None
        else np.array([servos.turned(angles, PERIOD) for angles in swings.tolist()]),
        caster_rates=np.array([caster.moved(twist, PERIOD) for twist in twists.tolist()]),
    )


def robots(effect: contract.Effect) -> tuple[Robot, ...]:
    """A robot on three omni wheels and one on four; robots on other wheels for an effect that applies to neither."""
    applies = tuple(robot for robot in synthetic_robots() if effect.applies(robot))
    return tuple(robot for robot in applies if robot.name in _OMNI) or applies


def trial_values(effect: contract.Effect, robot: Robot, seed: int = 0) -> Iterator[contract.Values]:
    """Parameters within their ranges, once for each choice of those that have choices."""
    rng = np.random.default_rng(seed)
    parameters = effect.parameters(robot, SESSIONS)
    free = {item.name: float(rng.uniform(item.low, item.high)) for item in parameters if not item.choices}
    shapes = [item for item in parameters if item.choices]
    for number in range(max((len(item.choices) for item in shapes), default=1)):
        chosen = {item.name: item.choices[number % len(item.choices)] for item in shapes}
        yield {item.name: chosen[item.name] if item.choices else free[item.name] for item in parameters}


def without(effect: contract.Effect, robot: Robot, values: contract.Values) -> contract.Values:
    """The values with every parameter that has no choices set to 0, at which the effect changes nothing."""
    shapes = {item.name for item in effect.parameters(robot, SESSIONS) if item.choices}
    return {name: value if name in shapes else 0.0 for name, value in values.items()}


def trial_input(effect: contract.Effect, robot: Robot, speed: float = 1.0, samples: int = SAMPLES) -> Input:
    """Input for an effect of this kind; speed as for ``driven_signals``."""
    if not isinstance(effect, contract.ReferenceEffect):
        signals = driven_signals(robot, samples, speed)
        motors = np.full(samples, PERIOD), signals.rates
        return motors if isinstance(effect, contract.ActuatorEffect) else signals
    poses = trial_poses(samples)
    return 0.25 * np.arange(1, samples + 1), poses[0] + speed * (poses - poses[0]), poses[0]


def trial_poses(count: int = SAMPLES) -> Array:
    """Poses (K, 3) on a curved path away from the origin."""
    angle = np.linspace(0.4, 2.4, count)
    return np.column_stack([1.0 + np.cos(angle), -2.0 + np.sin(2 * angle), 0.3 + angle])


def results(effect: contract.Effect, inputs: Input, values: contract.Values) -> dict[str, Array]:
    """Results of the effect's methods, by name; an effect that has weights gets its trial weights."""
    if isinstance(inputs, Signals):
        if effect.weighted:
            effect = effect.with_weights(effect.trial_weights(inputs.robot), inputs.robot, f"effect {effect.name!r}")
        assert isinstance(effect, contract.MotionEffect)
        return {"correction": effect.correction(inputs, values)}
    if len(inputs) == 2:
        assert isinstance(effect, contract.ActuatorEffect)
        return {"driven": effect.driven(inputs[0], inputs[1], values)}
    assert isinstance(effect, contract.ReferenceEffect)
    stamps, poses, start = inputs
    position, heading = effect.delays(stamps, values)
    return {
        "delays of position": position,
        "delays of heading": heading,
        "reported": effect.reported(poses, start, values),
        "corrected": effect.corrected(poses, start, values),
    }


def changes(effect: contract.Effect, inputs: Input, values: contract.Values) -> Array:
    """Changes by the effect: of wheel rates or twists (F, n), or of delays and poses, reported and corrected (K, 8)."""
    outputs = results(effect, inputs, values)
    changed = {"driven": inputs[1], "reported": inputs[1], "corrected": inputs[1]} if isinstance(inputs, tuple) else {}
    return np.column_stack([np.asarray(value) - changed.get(name, 0.0) for name, value in outputs.items()])


def arrays(inputs: Input) -> dict[str, Array]:
    """The arrays of an input by name."""
    if isinstance(inputs, tuple):
        return {str(number): array for number, array in enumerate(inputs)}
    values = {name: getattr(inputs, name) for name in type(inputs).__dataclass_fields__}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def one_row(inputs: Signals | Poses, row: int) -> Signals | Poses:
    """The input reduced to one sample or pose."""
    if isinstance(inputs, Signals):
        alone: dict[str, Any] = {name: value[row : row + 1] for name, value in arrays(inputs).items()}
        return replace(inputs, **alone)
    stamps, poses, start = inputs
    return stamps[row : row + 1], poses[row : row + 1], start


class EffectConformance(Conformance):
    """Requirements on every effect. Cases for another kind of effect are skipped."""

    registry = effects

    def trials(self) -> Iterator[tuple[Any, Robot, contract.Values, Input]]:
        """The effect on every trial robot, with its trial parameters and its input."""
        effect = self.make()
        for robot in robots(effect):
            for values in trial_values(effect, robot):
                yield effect, robot, values, trial_input(effect, robot)

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
        require(robots(effect), "applies is False for robots on omni, mecanum, fixed and steered wheels")
        everywhere = all(effect.applies(robot) for robot in synthetic_robots())
        require(everywhere or bool(effect.only_for), "only_for is missing: say in words to which robots it applies")

    def test_needs_are_known(self) -> None:
        """``needs`` holds names of the contract only."""
        unknown = set(self.make().needs) - set(get_args(contract.Need))
        require(not unknown, f"needs holds {sorted(map(str, unknown))}; known are {', '.join(get_args(contract.Need))}")

    def test_parameters_have_units_and_plausible_ranges(self) -> None:
        """Every parameter has a unit, a description and a finite range."""
        for robot in robots(self.make()):
            parameters = self.make().parameters(robot, SESSIONS)
            valid = isinstance(parameters, tuple) and all(isinstance(item, contract.Parameter) for item in parameters)
            require(valid, "parameters must give a tuple of Parameter")
            acts = any(not item.choices for item in parameters)
            require(acts, "it needs a parameter without choices, 0 for no effect")
            for parameter in parameters:
                place, low, high = f"parameter {parameter.name!r}", parameter.low, parameter.high
                named = bool(parameter.name) and parameter.name.isprintable()
                require(named, f"{place}: its name is empty, or cannot be printed")
                require(parameter.unit.strip(), f"{place} has no unit; that of a ratio is 1")
                require(parameter.description.strip(), f"{place} has no description")
                require(math.isfinite(low) and math.isfinite(high), f"{place}: its range is not finite")
                require(low < high, f"{place}: low {low:g} is not below high {high:g}")
                inside = all(low <= choice <= high for choice in parameter.choices)
                require(inside, f"{place}: a choice is not within {low:g} and {high:g}")
                zero = bool(parameter.choices) or low <= 0 <= high
                require(zero, f"{place}: 0, where it does not act, is not within {low:g} and {high:g}")

    def test_parameters_have_names_of_their_own(self) -> None:
        """Names are keys of the calibration file: unique, and the same in every call."""
        for robot in robots(self.make()):
            first, again = (self.make().parameters(robot, SESSIONS) for _ in range(2))
            names = [parameter.name for parameter in first]
            require(len(set(names)) == len(names), f"two parameters have one name: {', '.join(names)}")
            require(first == again, "parameters gives other parameters in a second call")

    def test_shapes_are_those_of_the_contract(self) -> None:
        """Results have the right shape for one sample and many, three wheels and four."""
        for (effect, robot, values, _), samples in product(self.trials(), (1, SAMPLES)):
            inputs = trial_input(effect, robot, samples=samples)
            for name, result in results(effect, inputs, values).items():
                shape, expected = np.shape(result), _shape(name, effect.stage, inputs, robot)
                require(shape == expected, f"{name} has shape {shape}, expected {expected}")

    def test_zero_parameters_change_nothing(self) -> None:
        """An effect whose parameters are 0 changes nothing."""
        for effect, robot, values, inputs in self.trials():
            largest = float(np.abs(changes(effect, inputs, without(effect, robot, values))).max())
            require(largest <= _NOTHING, f"parameters of 0 change something, by {largest:.3g}")

    def test_parameters_change_something(self) -> None:
        """It changes something in a varied drive."""
        effect = self.make()
        for robot in robots(effect):
            inputs = trial_input(effect, robot)
            acts = any((np.abs(changes(effect, inputs, values)) > 0).any() for values in trial_values(effect, robot))
            require(acts, f"no parameters change anything on {len(robot.wheel_names)} wheels")

    def test_results_are_finite(self) -> None:
        """Results are finite while the robot drives, drives fast and stands."""
        for (effect, robot, values, _), speed in product(self.trials(), (0.0, 1.0, 20.0)):
            finite = np.isfinite(changes(effect, trial_input(effect, robot, speed), values)).all()
            require(finite, f"a result is not finite where the robot {'drives' if speed else 'stands'}")

    def test_it_is_linear_in_its_parameters(self) -> None:
        """Fits and ``discover`` rely on it; parameters with choices are exempt."""
        effect = self.make()
        if isinstance(effect, contract.ActuatorEffect):
            raise SkipTest("only for effects that are fitted")
        # reported poses need be linear for small parameters only: rotations are not linear in their angle
        size, tolerance = (1.0, _ROUNDING) if isinstance(effect, contract.MotionEffect) else (1e-5, 1e-3)
        for robot in robots(effect):
            inputs = trial_input(effect, robot)
            for first, second in zip(trial_values(effect, robot, 1), trial_values(effect, robot, 2), strict=True):
                free = [name for name in first if first[name] != second[name]]
                one, other = (dict(values) | {name: size * values[name] for name in free} for values in (first, second))
                both = one | {name: one[name] - 2 * other[name] for name in free}
                of_one, of_other, of_both = (changes(effect, inputs, values) for values in (one, other, both))
                error = float(np.abs(of_both - (of_one - 2 * of_other)).max())
                scale = float(max(np.abs(of_one).max(), np.abs(of_other).max()))
                require(error <= tolerance * scale, f"it is not linear in its parameters: off by {error:.3g}")

    def test_inputs_are_left_unchanged(self) -> None:
        """Signals, poses and values are not overwritten."""
        for effect, _, values, inputs in self.trials():
            before, values_before = {name: array.copy() for name, array in arrays(inputs).items()}, dict(values)
            results(effect, inputs, values)
            same = all(np.array_equal(array, before[name]) for name, array in arrays(inputs).items())
            require(same and values == values_before, "it changed its arguments; work on copies")

    def test_each_sample_is_corrected_by_itself(self) -> None:
        """A sample is corrected the same alone, as in a stream, and in a batch."""
        for effect, _, values, inputs in self.trials():
            if not isinstance(inputs, Signals) and len(inputs) == 2:
                raise SkipTest("only for effects that act in a stream")
            together = changes(effect, inputs, values)
            for row in (0, 7, SAMPLES - 1, 3):
                alone = changes(effect, one_row(inputs, row), values)
                same = len(alone) == 1 and np.allclose(alone[0], together[row], rtol=1e-9, atol=_NOTHING)
                require(same, f"row {row} differs between a batch and a stream; it must not depend on other samples")

    def test_results_are_reproducible(self) -> None:
        """Results are equal in every call and instance, and no global random generator is used."""
        for _, _, values, inputs in self.trials():
            repeated = []
            for seed in (1, 2):
                with global_random_state(seed):
                    before = global_random_fingerprint()
                    effect = self.make()
                    repeated += [changes(effect, inputs, values) for _ in range(2)]
                    require(global_random_fingerprint() == before, "it draws random numbers")
            same = all(np.array_equal(repeated[0], result) for result in repeated[1:])
            require(same, "its results differ from call to call")

    def test_needs_names_all_that_is_used(self) -> None:
        """It works on recordings that lack everything which ``needs`` does not name."""
        effect = self.make()
        if not isinstance(effect, contract.MotionEffect):
            raise SkipTest("only for effects of motion")
        unused = _OPTIONAL - set(effect.needs)
        bare: dict[str, Any] = dict.fromkeys(unused)
        for _, robot, values, _ in self.trials():
            try:
                results(effect, replace(driven_signals(robot), **bare), values)
            except (TypeError, AttributeError) as error:
                missing = ", ".join(sorted(unused))
                require(False, f"without {missing} it raises {type(error).__name__}: {error}; name it in needs")

    def test_corrected_poses_are_the_true_ones(self) -> None:
        """``corrected`` is the inverse of ``reported``."""
        effect = self.make()
        if not isinstance(effect, contract.ReferenceEffect):
            raise SkipTest("only for effects of the reference")
        poses = trial_poses()
        for _, _, values, _ in self.trials():
            back = effect.corrected(effect.reported(poses, poses[0], values), poses[0], values)
            error = float(np.abs(back - poses).max())
            require(error <= _ROUNDING, f"corrected(reported(poses)) is off by {error:.3g}")

    def test_motors_are_causal(self) -> None:
        """Wheel rates depend on earlier targets only, and are 0 until the first target."""
        effect = self.make()
        if not isinstance(effect, contract.ActuatorEffect):
            raise SkipTest("only for effects of the motors")
        for _, robot, values, _ in self.trials():
            targets = driven_signals(robot).rates
            durations = np.full(SAMPLES, PERIOD)
            early = effect.driven(durations[:50], targets[:50], values)
            same = np.allclose(early, effect.driven(durations, targets, values)[:50], rtol=1e-9, atol=_NOTHING)
            require(same, "later targets change earlier wheel rates")
            still = effect.driven(durations, np.zeros_like(targets), values)
            require(not np.any(still), "the wheels turn though all targets are 0")


def _shape(result: str, stage: str, inputs: Input, robot: Robot) -> tuple[int, ...]:
    """The shape that the contract gives to a result."""
    if isinstance(inputs, Signals):
        widths = {"body": 3, "world": 2, "steering": len(robot.drive.steered)}
        return len(inputs.durations), widths.get(stage, len(robot.wheel_names))
    return inputs[0].shape if result.startswith("delays") else inputs[1].shape
