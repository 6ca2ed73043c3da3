"""The conformance cases of effects pass all of the catalogue and fail, case by case, what breaks the contract."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from commands import Command, assert_refused, succeeded

from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect, Effect, MotionEffect, Parameter, ReferenceEffect, Values
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals
from omnibench.testing import CaseOutcome, EffectConformance, run_cases

GAIN = Parameter("k", "1", -0.1, 0.1, "share that is added")


class Honest(MotionEffect):
    """Wheels that are a little larger; what the bad ones below are made from."""

    stage: ClassVar[Any] = "wheel"
    physics: ClassVar[str] = "Tyres grow."
    source: ClassVar[str] = "first principles"
    shows_in: ClassVar[str] = "command"
    given: ClassVar[tuple[Any, ...]] = (GAIN,)

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return self.given

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["k"] * signals.rates


class HonestReference(ReferenceEffect):
    """Late by a constant, and a map at another scale."""

    physics: ClassVar[str] = "The LIDAR is slow and the map is large."
    source: ClassVar[str] = "first principles"
    shows_in: ClassVar[str] = "stamps"

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return (GAIN,)

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        return values["k"] * np.ones(len(stamps)), 0 * stamps

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return self.scaled(poses, start, 1 + values["k"])

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return self.scaled(poses, start, 1 / (1 + values["k"]))

    def scaled(self, poses: Array, start: Array, scale: float) -> Array:
        return start + (poses - start) * [scale, scale, 1.0]


class HonestActuator(ActuatorEffect):
    """Motors that turn a share faster than they are told."""

    physics: ClassVar[str] = "The gain is wrong."
    source: ClassVar[str] = "first principles"
    shows_in: ClassVar[str] = "command"

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return (GAIN,)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:  # noqa: ARG002
        return (1 + values["k"]) * targets


def suite(cls: type[Effect]) -> EffectConformance:
    return type("Suite", (EffectConformance,), {"name": cls.__name__, "make": lambda _: cls()})()


def honest(**changes: Any) -> type[Effect]:
    return type("Changed", (Honest,), {"__doc__": "Changed.", **changes})


def correcting(correction: Callable[[Signals, Values], Array], **changes: Any) -> type[Effect]:
    return honest(correction=lambda _, signals, values: correction(signals, values), **changes)


def with_parameter(**changes: Any) -> type[Effect]:
    return honest(given=(replace(GAIN, **changes),))


@pytest.mark.parametrize("name", [entry.name for entry in effects.entries() if entry.origin == "built in"])
def test_an_effect_of_the_catalogue_keeps_the_contract(name: str) -> None:
    results = run_cases(type("Suite", (EffectConformance,), {"name": name})())
    assert [result for result in results if not result.passed] == []
    assert len([result for result in results if result.outcome is CaseOutcome.PASSED]) >= 13


@pytest.mark.parametrize("cls", [Honest, HonestReference, HonestActuator])
def test_an_honest_effect_of_each_kind_passes(cls: type[Effect]) -> None:
    assert [result for result in run_cases(suite(cls)) if not result.passed] == []


def scales_in_place(signals: Signals, values: Values) -> Array:
    signals.rates[:] *= 1 + values["k"]
    return values["k"] * signals.rates


def divides(signals: Signals, values: Values) -> Array:
    with np.errstate(all="ignore"):
        return values["k"] * signals.rates / signals.rates


def trembles(signals: Signals, values: Values) -> Array:
    return values["k"] * signals.rates * np.random.random()  # noqa: NPY002 (the fault that is to be found)


def trembles_by_itself(signals: Signals, values: Values) -> Array:
    return values["k"] * signals.rates * np.random.default_rng().random()


CALLS = count()

RANGES, SHAPES = "parameters have units and plausible ranges", "shapes are those of the contract"
STAGE, PHYSICS = "stage is one of its kind", "physics and source are given"
NAMES, ALONE = "parameters have names of their own", "each sample is corrected by itself"
ZERO, LINEAR, CAUSAL = "zero parameters change nothing", "it is linear in its parameters", "motors are causal"
DRAWS, NEEDS, TRUE = "results are reproducible", "needs names all that is used", "corrected poses are the true ones"
OUT_OF_RANGE = Parameter("n", "1", 3, 16, "rollers", choices=(3.0, 17.0))


def renamed(*_: Any) -> tuple[Parameter, ...]:
    return (replace(GAIN, description=f"{next(CALLS)}"),)


def reference(**changes: Any) -> type[Effect]:
    return type("Wrong", (HonestReference,), {"__doc__": "Wrong.", **changes})


def motors(driven: Callable[[Array, Values], Array]) -> type[Effect]:
    by_targets = {"driven": lambda _, __, targets, values: driven(targets, values)}
    return type("Wrong", (HonestActuator,), {"__doc__": "Wrong.", **by_targets})


# s: signals, v: values of the parameters.
BROKEN: dict[str, tuple[type[Effect], str, str]] = {
    "no docstring": (honest(__doc__=None), "class and options are documented", "has no docstring"),
    "no physics": (honest(physics=" "), PHYSICS, "physics is missing"),
    "no source": (honest(source=""), PHYSICS, "source is missing"),
    "no covariate": (honest(shows_in=""), PHYSICS, "shows_in is missing"),
    "an unknown stage": (honest(stage="tyre"), STAGE, "stage is 'tyre'; of a MotionEffect"),
    "another kind's stage": (honest(stage="reference"), STAGE, "wheel, steering, clock"),
    "a reference effect on wheels": (reference(stage="wheel"), STAGE, "'wheel'"),
    "an unknown need": (honest(needs=frozenset({"weather"})), "needs are known", "['weather']; known are wheel_angles"),
    "no parameter": (honest(given=()), RANGES, "without choices"),
    "a list of parameters": (honest(given=[GAIN]), RANGES, "tuple of Parameter"),
    "only a shape": (with_parameter(choices=(0.05,)), RANGES, "without choices"),
    "no unit": (with_parameter(unit=""), RANGES, "'k' has no unit"),
    "no description": (with_parameter(description=""), RANGES, "description"),
    "a range upside down": (with_parameter(low=0.1, high=-0.1), RANGES, "low 0.1"),
    "a range without 0": (with_parameter(low=0.9, high=1.1), RANGES, "not within 0.9 and 1.1"),
    "an endless range": (with_parameter(high=np.inf), RANGES, "not finite"),
    "a choice out of range": (honest(given=(GAIN, OUT_OF_RANGE)), RANGES, "'n'"),
    "one name twice": (honest(given=(GAIN, GAIN)), NAMES, "one name: k, k"),
    "names that change": (honest(parameters=renamed), NAMES, "second call"),
    "three wheels only": (correcting(lambda s, v: v["k"] * s.rates[:, :3]), SHAPES, "(1, 3), expected (1, 4)"),
    "a body's correction on wheels": (correcting(lambda s, v: v["k"] * s.twists), SHAPES, "expected (1, 4)"),
    "one number for all samples": (correcting(lambda s, v: v["k"] * s.rates[-1]), SHAPES, "(3,), expected (1, 3)"),
    "a constant": (correcting(lambda s, v: (0.01 + v["k"]) * s.rates), ZERO, "parameters of 0"),
    "nothing at all": (correcting(lambda s, _: 0 * s.rates), "parameters change something", "3 wheels"),
    "0/0": (correcting(divides), "results are finite", "not finite"),
    "a square": (correcting(lambda s, v: v["k"] ** 2 * s.rates), LINEAR, "not linear"),
    "a magnitude": (correcting(lambda s, v: abs(v["k"]) * s.rates), LINEAR, "not linear"),
    "work in place": (correcting(scales_in_place), "inputs are left unchanged", "it changed its arguments"),
    "a sum over samples": (correcting(lambda s, v: v["k"] * np.cumsum(s.rates, axis=0)), ALONE, "row 7 differs"),
    "a mean over samples": (correcting(lambda s, v: v["k"] * (s.rates - s.rates.mean(axis=0))), ALONE, "other"),
    "the global generator": (correcting(trembles), DRAWS, "it draws random numbers"),
    "a generator of its own": (correcting(trembles_by_itself), DRAWS, "results differ"),
    "angles it did not ask for": (correcting(lambda s, v: v["k"] * np.cos(s.wheel_angles)), NEEDS, "name it in needs"),
    "a correction the wrong way": (reference(corrected=HonestReference.reported), TRUE, "corrected(reported(poses))"),
    "delays of one kind": (
        reference(delays=lambda _, stamps, __: (0 * stamps,)),
        SHAPES,
        "not enough values to unpack",
    ),
    "one delay for all": (reference(delays=lambda _, __, v: (v["k"], 0.0)), SHAPES, "(), expected (1,)"),
    "a reference that is always wrong": (reference(reported=lambda _, poses, *__: poses + 0.1), ZERO, "by 0.1"),
    "motors that foresee": (motors(lambda targets, v: targets + v["k"] * targets[-1]), CAUSAL, "earlier"),
    "motors that creep": (motors(lambda targets, v: targets + v["k"]), CAUSAL, "targets are 0"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_effect_fails_the_case_it_breaks(fault: str) -> None:
    cls, case, words = BROKEN[fault]
    with pytest.raises(Exception) as failure:
        getattr(suite(cls), f"test_{case.replace(' ', '_')}")()
    assert words in str(failure.value)


FILE = '''"""A file with an effect."""
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter


@effects.register("broken_one")
class Broken(MotionEffect):
    """Forgets that there are robots with four wheels."""

    stage = "wheel"
    physics = "Tyres grow."
    source = "first principles"
    shows_in = "command"

    def parameters(self, robot, sessions=()):
        return (Parameter("k", "1", -0.1, 0.1, "growth"),)

    def correction(self, signals, values):
        return values["k"] * signals.rates[:, :3]
'''


def test_an_effect_is_made_checked_and_listed_on_the_command_line(command: Command) -> None:
    assert command("plugin", "new", "first_slip", "--effect").returncode == 0
    assert command("plugin", "new", "second_slip", "--kind", "effect").returncode == 0
    checked = succeeded(command("plugin", "check", "plugins/first_slip.py"))
    assert "passed  effect first_slip: it is linear in its parameters" in checked.stdout
    assert_refused(command("plugin", "new", "slip", "--effect", "--kind", "cost"), "--effect", "--kind cost")
    listed = command("list").stdout
    row = next(line for line in listed.splitlines() if "second_slip" in line)
    assert "The faster the robot drives" in row
    assert "second_slip.py" in "".join(listed.split())  # a long path is broken
    assert "built in" in next(line for line in listed.splitlines() if "heading_drift" in line)


@pytest.mark.slow
def test_a_broken_effect_ends_in_exit_code_1(command: Command) -> None:
    Path("broken.py").write_text(FILE, encoding="utf-8")
    checked = command("plugin", "check", "broken.py")
    assert checked.returncode == 1
    assert f"failed  effect broken_one: {SHAPES}: " in checked.stdout
