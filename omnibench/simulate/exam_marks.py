"""Marks of an exam: answers, as ``omnibench discover`` writes them or by hand, against the hidden effects.

A name is given if its weight is at least 0.95. A hidden effect is right if its name is given; it is in the class if it
is among the names that an answer cannot tell apart; otherwise it is unknown. A given name is wrong if neither it nor
any of its class is hidden. A place is right if it is among the covariates in which a hidden effect shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, TypeAdapter, field_validator

from omnibench.config import validate
from omnibench.errors import DataError, require_choice
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, form_covariates
from omnibench.robot.kinematics import class_of
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.exam import read_json

SURE = 0.95  # weight from which on a name is given, as the verdict "named" of discover
_LIKELY = 0.1  # weight of a covariate from which on it is named, where an answer has weights; chosen
_Z = 1.959964  # standard deviations of a 95 % interval
# Covariates of an answer by those with which the size of an effect varies.
_PLACES = {
    "speed": "command", "turning": "command", "centripetal acceleration": "command", "distance": "elapsed time",
    "session time": "order of runs",
}  # fmt: skip


class AnsweredEffect(BaseModel):
    """An effect that an answer names. confusable_with: names that the recordings cannot tell from it."""

    name: str
    weight: float = Field(1.0, ge=0, le=1, description="probability that the name is right")
    confusable_with: tuple[str, ...] = ()


class AnsweredPlace(BaseModel):
    """A covariate that the residuals depend on. weight: probability that it is this one."""

    covariate: str
    weight: float = Field(1.0, ge=0, le=1)


class Answer(BaseModel):
    """The answer on one set: the parts of discovery.json that are marked; others are ignored."""

    verdict: Literal["none", "named", "class", "incomplete", "unknown"]
    effects: tuple[AnsweredEffect, ...] = ()
    where: tuple[AnsweredPlace, ...] = Field((), description="covariates, as objects or by their names alone")

    @field_validator("where", mode="before")
    @classmethod
    def _by_names(cls, where: Any) -> Any:
        places = where if isinstance(where, list | tuple) else [where]
        return [{"covariate": place} if isinstance(place, str) else place for place in places]

    @property
    def given(self) -> tuple[AnsweredEffect, ...]:
        """The effects whose names are given."""
        return tuple(effect for effect in self.effects if effect.weight >= SURE)

    @property
    def in_class(self) -> set[str]:
        """Names of all effects that may be the ones, unless the answer is that none has a name."""
        if self.verdict in ("none", "unknown"):
            return set()
        return {name for effect in self.effects for name in (effect.name, *effect.confusable_with)}


_NO_ANSWER = Answer(verdict="unknown")


@dataclass(frozen=True)
class Rate:
    """A share with its 95 % interval. of: how many could count; count: how many do."""

    count: float
    of: float
    share: float | None
    low: float
    high: float


@dataclass(frozen=True)
class SetMark:
    """The mark of one set. marks: right, class or unknown, of each hidden effect. wrong: names given but not hidden."""

    name: str
    robot: str
    hidden: tuple[str, ...]
    verdict: str
    marks: tuple[str, ...]
    wrong: tuple[str, ...]
    places: tuple[str, ...]


@dataclass(frozen=True)
class ExamMarks:
    """The marks of an exam.

    rates: right, class, unknown: of the hidden effects. wrong: of the names given. none_right, false_alarms: of the
    sets with nothing hidden, those of verdict none, and those in which a name or a class is given. place_f1: of the
    covariates (F1).
    """

    by_set: tuple[SetMark, ...]
    answered: int
    rates: dict[str, Rate]

    @property
    def document(self) -> dict[str, Any]:
        """The document of ``exam grade --json``: counts, the F1, and all of them as rates."""
        counts = {name: rate.count for name, rate in self.rates.items()}
        hidden = {"sets": len(self.by_set), "answered": self.answered, "hidden": self.rates["right"].of}
        rates = {name: asdict(rate) for name, rate in self.rates.items()}
        place_f1 = self.rates["place_f1"].share
        return {**hidden, **counts, "place_f1": place_f1, "rates": rates, "by_set": [asdict(s) for s in self.by_set]}


def answer_schema() -> dict[str, Any]:
    """JSON schema of ANSWERS.json: answers by the names of sets."""
    return TypeAdapter(dict[str, Answer]).json_schema()


def read_answers(path: Path, sets: Mapping[str, Any]) -> dict[str, Answer]:
    """Answers by the names of sets, of a JSON file, or of a folder that holds SET/discovery.json.

    OmnibenchError in one line: there are none, or one names a set, an effect or a covariate that is not known.
    """
    if path.is_dir():
        found = {file.parent.name: (str(file), read_json(file)) for file in sorted(path.glob("*/discovery.json"))}
        found = {name: answer for name, answer in found.items() if name in sets}
        if not found:
            raise DataError(f"{path}: holds no SET/discovery.json, such as {next(iter(sets))}/discovery.json")
    else:
        content = read_json(path)
        if not isinstance(content, dict):
            raise DataError(f"{path}: expected answers by the names of sets, found {type(content).__name__}")
        found = {name: (f"{path}: {name}", answer) for name, answer in content.items()}
    entries = effects.entries()
    names, covariates = {entry.name for entry in entries}, {entry.cls.shows_in for entry in entries}
    answers = {}
    for name, (where, content) in found.items():
        require_choice("set", name, sets, str(path))
        answers[name] = answer = validate(Answer, content, where)
        for effect in answer.effects:
            for each in (effect.name, *effect.confusable_with):
                require_choice("effect", each, names, where)
        for place in answer.where:
            require_choice("covariate", place.covariate, covariates, where)
    return answers


def shows_in(name: str) -> set[str]:
    """The covariates in which an effect shows: its own, those with which its size may vary, stamps if it delays."""
    effect = effects.create(name)
    found, varies = {effect.shows_in}, form_covariates(effect) if isinstance(effect, MotionEffect) else ()
    if isinstance(effect, ReferenceEffect) and type(effect).delays is not ReferenceEffect.delays:
        found.add("stamps")
    return found | {_PLACES.get(covariate, covariate) for covariate in varies}


def mark_exam(configs: Mapping[str, FlowerConfig], answers: Mapping[str, Answer]) -> ExamMarks:
    """Marks of the answers on sets with these configs; a missing answer counts as unknown."""
    by_set = []
    given_names, alarms, found, misplaced = 0, 0, 0, 0
    for name, config in configs.items():
        answer, hidden = answers.get(name, _NO_ANSWER), tuple(term.name for term in config.truth.effects)
        given, in_class = {effect.name for effect in answer.given}, answer.in_class
        marks = ["right" if each in given else "class" if each in in_class else "unknown" for each in hidden]
        wrong = [each.name for each in answer.given if {each.name, *each.confusable_with}.isdisjoint(hidden)]
        places = {place.covariate for place in answer.where if place.weight >= _LIKELY}
        by_set.append(
            SetMark(
                name,
                class_of(config.robot),
                hidden,
                answer.verdict if name in answers else "no answer",
                tuple(marks),
                tuple(wrong),
                tuple(sorted(places)),
            )
        )
        given_names += len(given)
        alarms += not hidden and bool(given or in_class)
        covariates = [shows_in(each) for each in hidden]
        found += sum(not each.isdisjoint(places) for each in covariates)
        misplaced += len(places.difference(*covariates))
    all_marks = [mark for each in by_set for mark in each.marks]
    nothing = [each for each in by_set if not each.hidden]
    rates = {mark: rate(all_marks.count(mark), len(all_marks)) for mark in ("right", "class", "unknown")} | {
        "wrong": rate(sum(len(each.wrong) for each in by_set), given_names),
        "none_right": rate(sum(each.verdict == "none" for each in nothing), len(nothing)),
        "false_alarms": rate(alarms, len(nothing)),
        "place_f1": rate(found, (found + misplaced + len(all_marks)) / 2),
    }
    return ExamMarks(tuple(by_set), len(answers), rates)


def rate(count: float, of: float) -> Rate:
    """A share with its 95 % interval, Wilson's score interval."""
    if not of:
        return Rate(count, of, None, 0.0, 1.0)
    share, z2 = count / of, _Z**2 / of
    middle, half = (share + z2 / 2) / (1 + z2), math.sqrt(share * (1 - share) * z2 + z2**2 / 4) / (1 + z2)
    return Rate(count, of, share, max(middle - half, 0.0), min(middle + half, 1.0))
