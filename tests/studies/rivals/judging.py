"""Judging the answers of rivals against the truth of hidden sets."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from hidden.disturbances import NULL_KINDS, VALIDATION, scaled
from hidden.forms import FORMS
from hidden.judging import CONFIDENT
from hidden.sets import Truth, make_set
from hidden.signature import Sight, projected
from hidden.tasks import Task

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import Whitener
from omnibench.processes import one_thread
from omnibench.progress import Reporter
from omnibench.registry import effects
from omnibench.robot.kinematics import Array

from .problem import Answer, Problem, commands_of_kinds, make_problem


@dataclass(frozen=True)
class Rival:
    """A rival with its settings. label: of the table. module: in this folder, with a function ``answer``.

    quickly: settings where only the prediction is wanted, as its confidence costs time.
    """

    label: str
    module: str
    settings: dict[str, Any] = field(default_factory=dict)
    quickly: dict[str, Any] = field(default_factory=dict)

    def answer(self, problem: Problem, seed: int, *, quick: bool = False) -> Answer:
        function: Callable[..., Answer] = importlib.import_module(f"rivals.{self.module}").answer
        return function(problem, np.random.default_rng(seed), **self.settings, **(self.quickly if quick else {}))


RIVALS: dict[str, Rival] = {
    "discover": Rival("discover", "itself"),
    "strong": Rival("PySINDy, STLSQ", "sindy", {"form": "strong"}, {"bags": 0}),
    "weak": Rival("PySINDy, weak form", "sindy", {"form": "weak"}, {"bags": 0}),
    "whitened": Rival("PySINDy, whitened rows", "sindy", {"form": "whitened"}, {"bags": 0}),
    "symbolic": Rival("symbolic regression (pyoperon)", "symbolic", {}, {"bags": 0}),
    "gaussian": Rival("Gaussian process discrepancy", "gaussian"),
    "lisdd": Rival("localise, select, F test (LISDD)", "lisdd", {"local": False}),
    "lisdd_local": Rival("LISDD, in flagged regimes alone", "lisdd", {"local": True}),
}


class Figures(Model):
    """One rival on one set. names: with their confidence. right: the first name is hidden. wrong: a name is confident
    and hidden is nothing of it. place: F1 of its covariates. closed, closed_kind: share of the squared whitened errors
    that is gone, on the validation session and on a kind of motion that it was not shown. parameter_error: length of
    the error over that of the true parameters. seconds: of the processor.
    """

    names: tuple[tuple[str, float], ...] = ()
    unnamed: bool = False
    covariates: tuple[str, ...] = ()
    right: bool = False
    in_class: bool = False
    wrong: bool = False
    place: float | None = None
    closed: float | None = None
    closed_kind: float | None = None
    parameter_error: float | None = None
    seconds: float = 0.0
    failure: str = ""

    @property
    def says_something(self) -> bool:
        return self.unnamed or bool(self.names)


class Result(Model):
    """All rivals that were asked on one set."""

    task: Task
    reachable: bool
    figures: dict[str, Figures]


def carry_out(asked: tuple[Task, tuple[str, ...], bool, str | None], _: Reporter) -> Result:
    """Make a set, ask rivals, judge.

    asked: task, rivals, True if they are asked again without a kind of motion, and the design, None for the usual one.
    """
    task, rivals, kinds, design = asked
    with one_thread():
        noise = NULL_KINDS[task.seed % len(NULL_KINDS)] if task.group == "null" else "plain"
        dataset, truth = make_set(
            task.kind, task.effects, task.level, task.seed, form=task.form, noise=noise, design=design
        )
        began = time.process_time()
        problem, figures = make_problem(dataset), dict[str, Figures]()
        _ = problem.screening
        shared = time.process_time() - began  # what each rival but discover, which does it itself, is spared
        held_out = commands_of_kinds(dataset)
        kind = held_out[task.seed % len(held_out)]
        fewer = (
            make_problem(dataset, kind) if kinds and task.group != "null" and "tyre_wear" not in truth.names else None
        )
        clean = [run for run in truth.clean if run.split == "validation"]
        for name in rivals:
            began = time.process_time()
            try:
                answer = RIVALS[name].answer(problem, task.seed)
                seconds = time.process_time() - began + (shared if name != "discover" else 0.0)
                figures[name] = judged(answer, truth, problem, clean).model_copy(update={"seconds": seconds})
                if fewer is not None:
                    again = RIVALS[name].answer(fewer, task.seed, quick=True)
                    closed = _closed(again, truth, fewer, [run for run in clean if run.command in kind])
                    figures[name] = figures[name].model_copy(update={"closed_kind": closed})
            except Exception as error:  # the study goes on, and the table says so
                figures[name] = Figures(failure=f"{type(error).__name__}: {error}")
    return Result(task=task, reachable=truth.reachable, figures=figures)


def judged(answer: Answer, truth: Truth, problem: Problem, clean: Sequence[Trajectory]) -> Figures:
    """The answer beside the truth. clean: validation runs without noise."""
    hidden = set(truth.called if truth.kind == "outside" else truth.names)  # in the catalogue
    first = answer.names[0][0] if answer.names and not answer.unnamed else ""
    shown = set(truth.covariates) or {effects.create(name).shows_in for name in hidden}
    measurable = bool(truth.hidden) and "tyre_wear" not in hidden
    return Figures(
        names=answer.names,
        unnamed=answer.unnamed,
        covariates=tuple(sorted(answer.covariates)),
        right=first in hidden,
        in_class=bool({first, *answer.alike} & hidden),
        wrong=any(name not in hidden and confidence >= CONFIDENT for name, confidence in answer.names),
        place=_f1(set(answer.covariates), shown) if truth.hidden else None,
        closed=_closed(answer, truth, problem, clean) if measurable else None,
        parameter_error=_parameter_error(answer, truth) if first in hidden else None,
    )


def _f1(stated: set[str], true: set[str]) -> float:
    """F1 of covariates; of several that show the same, one is enough."""
    hits = len(stated & true)
    return 2 * hits / (len(stated) + hits) if hits else 0.0


def _closed(answer: Answer, truth: Truth, problem: Problem, runs: Sequence[Trajectory]) -> float | None:
    """Share of the squared errors of noiseless runs, whitened under their noise, that the answer takes away."""
    noise = scaled(truth.disturbance, VALIDATION).known(truth.matrix)
    before = after = 0.0
    plain = problem.plain.model.reported([run.reference_log for run in runs])
    for run, poses, change in zip(runs, plain, answer.changes(runs), strict=True):
        whitener, left = Whitener(noise, run.pose_times[1:]), run.poses[1:] - poses
        before += float(np.square(whitener(left)).sum())
        after += float(np.square(whitener(left - change)).sum())
    return 1 - after / before


@lru_cache(maxsize=1)  # all rivals are judged on one set after the other
def _seen(truth: Truth) -> tuple[Sight, Array]:
    """How effects are seen in a set's training runs, and the whitened signature of what is hidden."""
    sight = truth.sight()
    return sight, truth.signature(sight)


def _parameter_error(answer: Answer, truth: Truth) -> float | None:
    """Length of the error of the first name's parameters over that of the projection of what is hidden onto it."""
    if truth.kind != "single" or not answer.values:
        return None
    hidden, (sight, signature) = truth.hidden[0], _seen(truth)
    shapes = {name: answer.values.get(name, hidden.values[name]) for name in hidden.values}
    true, _ = projected(sight, FORMS[hidden.name], shapes, signature)
    known = [name for name in FORMS[hidden.name].plausible if name in answer.values]
    errors = np.array([answer.values[name] - true[name] for name in known])
    return float(np.linalg.norm(errors) / np.linalg.norm([true[name] for name in known])) if known else None
