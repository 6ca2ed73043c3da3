"""``discover`` itself, judged as its rivals are."""

from __future__ import annotations

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.discover import discover_effects
from omnibench.discover.result import lacks_a_name
from omnibench.registry import effects
from omnibench.robot.kinematics import Array

from .problem import Answer, Problem

_PLACES = 0.25  # probability from which on a covariate counts as one that it states; chosen


def answer(problem: Problem, rng: np.random.Generator) -> Answer:
    """The discovery. Names under the verdict "unknown" are no answer; covariates of what has no name are stated."""
    discovery = discover_effects(problem.dataset, seed=int(rng.integers(2**31)))
    named = discovery.verdict != "unknown"
    first = discovery.effects[0] if discovery.effects and named else None
    covariates = {effects.create(each.name).shows_in for each in discovery.effects} if named else set()
    if lacks_a_name(discovery.verdict):
        left = discovery.left if named else discovery.where
        covariates |= {each.covariate for each in left if each.weight >= _PLACES}

    def changes(runs: list[Trajectory]) -> list[Array]:
        logs = [run.reference_log for run in runs]
        pairs = zip(discovery.extended.model.reported(logs), problem.plain.model.reported(logs), strict=True)
        return [extended - plain for extended, plain in pairs]

    return Answer(
        names=tuple((each.name, each.weight) for each in discovery.effects),
        unnamed=not named,
        covariates=frozenset(covariates),
        values={each.name: each.value for each in first.parameters if ":" not in each.name} if first else {},
        changes=changes,
        alike=frozenset(first.confusable_with) if first else frozenset(),
    )
