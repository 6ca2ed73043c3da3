"""The data sets of the study, and the result on each."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Literal

from omnibench.config import Model
from omnibench.discover.discover import discover_effects
from omnibench.processes import one_thread
from omnibench.progress import Reporter, no_progress

from .absorbed import ABSORBED, ACTUATORS, NUISANCES
from .disturbances import NULL_KINDS
from .fine_structure import FINE
from .forms import FORMS
from .judging import Judgement, judge
from .outside import OUTSIDE
from .pairs import PAIRS
from .sets import LEVELS, FormName, Kind, make_set

NULLS = 60  # for every seed of the others: 1200 with 20 seeds
Group = Literal[
    "single", "matched", "third", "removed", "pair", "outside", "fine", "null", "absorbed", "nuisance", "actuator"
]
GROUPS: tuple[Group, ...] = (
    "single",
    "null",
    "pair",
    "outside",
    "fine",
    "removed",
    "matched",
    "third",
    "absorbed",
    "nuisance",
    "actuator",
)


class Task(Model):
    """One data set to be made and judged. effects: names; level: a non-centrality."""

    group: Group
    effects: tuple[str, ...]
    level: float
    seed: int

    @property
    def key(self) -> str:
        return f"{self.group} {'+'.join(self.effects)} {self.level:g} {self.seed}"

    @property
    def kind(self) -> Kind:
        """Kind of the set: matched and third forms, and sets whose name is taken away, hold single effects."""
        if self.group == "matched" or self.group == "third" or self.group == "removed":
            return "single"
        return "outside" if self.group == "fine" else self.group

    @property
    def form(self) -> FormName:
        """Form of the effects: matched and third where the group says so."""
        return self.group if self.group == "matched" or self.group == "third" else "blind"


class Result(Model):
    """What came of a task. size: how large the effect had to be, in plausible ranges. failure: of the workflow."""

    task: Task
    design: str
    noise: str
    size: float
    reachable: bool
    judgement: Judgement | None
    failure: str = ""


def tasks(seeds: range, levels: tuple[float, ...], groups: tuple[Group, ...]) -> Iterator[Task]:
    """Every set, seed by seed, so that a study which is stopped early has a little of all."""
    for seed in seeds:
        for group in groups:
            for names, level in _of(group, levels):
                yield Task(group=group, effects=names, level=level, seed=seed)
            if group == "null":
                for index in range(NULLS):
                    yield Task(group="null", effects=(), level=0.0, seed=NULLS * seed + index)


def _of(group: Group, levels: tuple[float, ...]) -> Iterator[tuple[tuple[str, ...], float]]:
    strong = LEVELS["strong"]
    if group in ("single", "matched", "third"):
        yield from (((name,), level) for name in FORMS for level in levels)
    elif group == "removed":
        yield from (((name,), strong) for name in FORMS)
    elif group == "pair":
        yield from ((pair, strong) for pair in PAIRS)
    elif group in ("outside", "fine"):
        unheard = OUTSIDE if group == "outside" else FINE
        yield from (((name,), level) for name in unheard for level in (strong, LEVELS["medium"]))
    elif group != "null":
        known = {"absorbed": ABSORBED, "nuisance": NUISANCES, "actuator": ACTUATORS}[group]
        yield from (((name,), strong) for name in known)


def carry_out(task: Task, _: Reporter = no_progress) -> Result:
    """Make the set, let the workflow discover, judge. Whatever the workflow raises is a failure, and counts as one."""
    with one_thread():
        noise = NULL_KINDS[task.seed % len(NULL_KINDS)] if task.group == "null" else "plain"
        dataset, truth = make_set(task.kind, task.effects, task.level, task.seed, form=task.form, noise=noise)
        began = time.perf_counter()
        judgement, failure = None, ""
        try:
            without = task.effects if task.group == "removed" else ()
            discovery = discover_effects(dataset, without=without, seed=task.seed)
            judgement = judge(discovery, truth, time.perf_counter() - began)
        except Exception as error:  # the study goes on, and the table says so
            failure = f"{type(error).__name__}: {error}"
    return Result(
        task=task,
        design=truth.design,
        noise=truth.noise,
        size=max((each.size for each in truth.hidden), default=0.0),
        reachable=truth.reachable,
        judgement=judgement,
        failure=failure,
    )
