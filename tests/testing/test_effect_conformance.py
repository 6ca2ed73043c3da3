"""The conformance cases of effects pass all of the catalogue and fail, case by case, what breaks the contract."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any, ClassVar

import numpy as np
import pytest
from commands import Command, assert_refused

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


def failures(cls: type[Effect]) -> dict[str, str]:
    """The cases that an effect fails, and what is said of each."""
    suite = type("Suite", (EffectConformance,), {"name": cls.__name__, "make": lambda _: cls()})()
    return {result.case: result.message for result in run_cases(suite) if not result.passed}


def honest(**changes: Any) -> type[Effect]:
    return type("Changed", (Honest,), {"__doc__": "Changed.", **changes})


def correcting(correction: Callable[[Signals, Values], Array], **changes: Any) -> type[Effect]:
    return honest(correction=lambda _, signals, values: correction(signals, values), **changes)


def with_parameter(**changes: Any) -> type[Effect]:
    return honest(given=(replace(GAIN, **changes),))


@pytest.mark.parametrize("name", [entry.name for entry in effects.entries() if entry.origin == "built in"])
def test_an_effect_of_the_catalogue_keeps_the_contract(name: str) -> None:
    suite = type("Suite", (EffectConformance,), {"name": name})()
    results = run_cases(suite)
    assert [result for result in results if not result.passed] == []
    assert len([result for result in results if result.outcome is CaseOutcome.PASSED]) >= 13


@pytest.mark.parametrize("cls", [Honest, HonestReference, HonestActuator])
def test_an_honest_effect_of_each_kind_passes(cls: type[Effect]) -> None:
    assert failures(cls) == {}


def scales_in_place(signals: Signals, values: Values) -> Array:
    signals.rates[:] *= 1 + values["k"]
    return values["k"] * signals.rates


def smooths(signals: Signals, values: Values) -> Array:
    return values["k"] * np.cumsum(signals.rates, axis=0)


def takes_the_mean(signals: Signals, values: Values) -> Array:
    return values["k"] * (signals.rates - signals.rates.mean(axis=0))


def divides(signals: Signals, values: Values) -> Array:
    with np.errstate(all="ignore"):
        return values["k"] * signals.rates / signals.rates


def trembles(signals: Signals, values: Values) -> Array:
    return values["k"] * signals.rates * np.random.random()  # noqa: NPY002 (the fault that is to be found)


def trembles_by_itself(signals: Signals, values: Values) -> Array:
    return values["k"] * signals.rates * np.random.default_rng().random()


CALLS = count()

BROKEN: dict[str, tuple[type[Effect], str, str]] = {
    "no docstring": (honest(__doc__=None), "class and options are documented", "has no docstring"),
    "no physics": (honest(physics=" "), "physics and source are given", "physics is missing"),
    "no source": (honest(source=""), "physics and source are given", "source is missing"),
    "no covariate": (honest(shows_in=""), "physics and source are given", "shows_in is missing"),
    "an unknown stage": (honest(stage="tyre"), "stage is one of its kind", "stage is 'tyre'; of a MotionEffect"),
    "another kind's stage": (honest(stage="reference"), "stage is one of its kind", "one of wheel, steering, clock, "),
    "a reference effect on wheels": (
        type("Wrong", (HonestReference,), {"__doc__": "Wrong.", "stage": "wheel"}),
        "stage is one of its kind",
        "stage is 'wheel'; of a ReferenceEffect it is one of reference",
    ),
    "an unknown need": (honest(needs=frozenset({"weather"})), "needs are known", "['weather']; known are wheel_angles"),
    "no parameter": (
        honest(given=()),
        "parameters have units and plausible ranges",
        "a parameter without choices",
    ),
    "a list of parameters": (honest(given=[GAIN]), "parameters have units and plausible ranges", "tuple of Parameter"),
    "only a shape": (
        with_parameter(choices=(0.05,)),
        "parameters have units and plausible ranges",
        "a parameter without choices",
    ),
    "no unit": (with_parameter(unit=""), "parameters have units and plausible ranges", "'k' has no unit"),
    "no description": (
        with_parameter(description=""),
        "parameters have units and plausible ranges",
        "'k' has no description",
    ),
    "a range upside down": (
        with_parameter(low=0.1, high=-0.1),
        "parameters have units and plausible ranges",
        "low 0.1 is not below high -0.1",
    ),
    "a range without 0": (
        with_parameter(low=0.9, high=1.1),
        "parameters have units and plausible ranges",
        "0, where it does not act, is not within 0.9 and 1.1",
    ),
    "an endless range": (
        with_parameter(high=np.inf),
        "parameters have units and plausible ranges",
        "its range is not finite",
    ),
    "a choice out of range": (
        honest(given=(GAIN, Parameter("n", "1", 3, 16, "rollers", choices=(3.0, 17.0)))),
        "parameters have units and plausible ranges",
        "parameter 'n': a choice is not within 3 and 16",
    ),
    "one name twice": (honest(given=(GAIN, GAIN)), "parameters have names of their own", "one name: k, k"),
    "names that change": (
        honest(parameters=lambda *_: (replace(GAIN, description=f"{next(CALLS)}"),)),
        "parameters have names of their own",
        "gives other parameters in a second call",
    ),
    "three wheels only": (
        correcting(lambda signals, values: values["k"] * signals.rates[:, :3]),
        "shapes are those of the contract",
        "correction has shape (1, 3), expected (1, 4)",
    ),
    "a body's correction on wheels": (
        correcting(lambda signals, values: values["k"] * signals.twists),
        "shapes are those of the contract",
        "expected (1, 4)",
    ),
    "one number for all samples": (
        correcting(lambda signals, values: values["k"] * signals.rates[-1]),
        "shapes are those of the contract",
        "correction has shape (3,), expected (1, 3)",
    ),
    "a constant": (
        correcting(lambda signals, values: (0.01 + values["k"]) * signals.rates),
        "zero parameters change nothing",
        "parameters of 0 change something, by ",
    ),
    "nothing at all": (
        correcting(lambda signals, _: 0 * signals.rates),
        "parameters change something",
        "no parameters change anything on 3 wheels",
    ),
    "0/0": (correcting(divides), "results are finite", "not finite where the robot stands"),
    "a square": (
        correcting(lambda signals, values: values["k"] ** 2 * signals.rates),
        "it is linear in its parameters",
        "not linear in its parameters: off by ",
    ),
    "a magnitude": (
        correcting(lambda signals, values: abs(values["k"]) * signals.rates),
        "it is linear in its parameters",
        "not linear in its parameters",
    ),
    "work in place": (correcting(scales_in_place), "inputs are left unchanged", "it changed its arguments"),
    "a sum over samples": (
        correcting(smooths),
        "each sample is corrected by itself",
        "row 7 differs",
    ),
    "a mean over samples": (
        correcting(takes_the_mean),
        "each sample is corrected by itself",
        "must not depend on other",
    ),
    "the global generator": (correcting(trembles), "results are reproducible", "it draws random numbers"),
    "a generator of its own": (correcting(trembles_by_itself), "results are reproducible", "results differ"),
    "angles it did not ask for": (
        correcting(lambda signals, values: values["k"] * np.cos(signals.wheel_angles)),
        "needs names all that is used",
        "name it in needs",
    ),
    "a correction the wrong way": (
        type("Wrong", (HonestReference,), {"__doc__": "Wrong.", "corrected": HonestReference.reported}),
        "corrected poses are the true ones",
        "corrected(reported(poses)) is off by ",
    ),
    "delays of one kind": (
        type("Wrong", (HonestReference,), {"__doc__": "Wrong.", "delays": lambda _, stamps, __: (0 * stamps,)}),
        "shapes are those of the contract",
        "not enough values to unpack",
    ),
    "one delay for all": (
        type("Wrong", (HonestReference,), {"__doc__": "Wrong.", "delays": lambda _, __, values: (values["k"], 0.0)}),
        "shapes are those of the contract",
        "delays of position has shape (), expected (1,)",
    ),
    "a reference that is always wrong": (
        type("Wrong", (HonestReference,), {"__doc__": "Wrong.", "reported": lambda _, poses, *__: poses + 0.1}),
        "zero parameters change nothing",
        "by 0.1",
    ),
    "motors that foresee": (
        type("Wrong", (HonestActuator,), {"__doc__": "Wrong.", "driven": lambda _, __, t, v: t + v["k"] * t[-1]}),
        "motors are causal",
        "later targets change earlier wheel rates",
    ),
    "motors that creep": (
        type("Wrong", (HonestActuator,), {"__doc__": "Wrong.", "driven": lambda _, __, t, v: t + v["k"]}),
        "motors are causal",
        "the wheels turn though all targets are 0",
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_effect_fails_the_case_it_breaks(fault: str) -> None:
    cls, case, words = BROKEN[fault]
    found = failures(cls)
    assert words in found[case]


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


class TestOnTheCommandLine:
    def test_an_effect_is_made_by_its_flag_and_by_its_kind(self, command: Command) -> None:
        for name, kind in (("first_slip", ["--effect"]), ("second_slip", ["--kind", "effect"])):
            assert command("plugin", "new", name, *kind).returncode == 0
            checked = command("plugin", "check", f"plugins/{name}.py")
            assert checked.returncode == 0
            assert f"passed  effect {name}: it is linear in its parameters" in checked.stdout

    def test_an_effect_is_listed_with_where_it_comes_from(self, command: Command) -> None:
        command("plugin", "new", "listed_slip", "--effect")
        listed = command("list").stdout
        row = next(line for line in listed.splitlines() if "listed_slip" in line)
        assert "The faster the robot drives" in row
        assert "listed_slip.py" in "".join(listed.split())  # a long path is broken
        assert "built in" in next(line for line in listed.splitlines() if "heading_drift" in line)

    def test_a_flag_that_contradicts_the_kind_is_refused(self, command: Command) -> None:
        refused = command("plugin", "new", "slip", "--effect", "--kind", "cost")
        assert_refused(refused, "--effect and --kind cost contradict each other")

    def test_a_broken_effect_ends_in_exit_code_1(self, command: Command) -> None:
        with open("broken.py", "w", encoding="utf-8") as file:
            file.write(FILE)
        checked = command("plugin", "check", "broken.py")
        assert checked.returncode == 1
        told = (
            "failed  effect broken_one: shapes are those of the contract: correction has shape (1, 3), expected (1, 4)"
        )
        assert told in checked.stdout
