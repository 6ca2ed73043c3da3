"""The paper's search: a real-coded genetic algorithm with the defaults of a standard toolbox, in NumPy."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array

# Least step of the mutation, as a share of the box. The fittest of 20 generations is the same with half of it and with
# twice (tests/studies/constants_fit.py).
_SMALLEST_STEP = 1e-8


class GeneticOptions(Options):
    """Options of a real-coded GA, with defaults of a standard toolbox; the paper (section 3) gives ``tolerance``."""

    population: int | None = Field(None, ge=4, description="default: 200 for more than five variables, else 50")
    elite: float = Field(0.05, gt=0, lt=1, description="share that survives unchanged")
    crossover: float = Field(0.8, ge=0, le=1, description="share of the other children made by scattered crossover")
    mutation: Literal["adaptive_feasible", "gaussian"] = Field(
        "adaptive_feasible", description="how a child is varied; gaussian steps are clipped to the box"
    )
    generations: int | None = Field(None, gt=0, description="default: 100 for each variable")
    stall_generations: int = Field(50, gt=0, description="window of the stopping rule")
    tolerance: float = Field(1e-6, ge=0, description="average relative change of the best over the window")

    def size(self, variables: int) -> int:
        """Number of candidates in a generation."""
        return self.population or (200 if variables > 5 else 50)


@calibrators.register("genetic")
class Genetic(Calibrator):
    """The paper's genetic algorithm: stochastic uniform selection, scattered crossover, feasible mutation, elite."""

    Options = GeneticOptions
    options: GeneticOptions

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Evolve a population around the start until the best stalls."""
        variables = int(problem.free.sum())
        count = self.options.size(variables)
        generations = self.options.generations or 100 * variables
        mutate = _AdaptiveFeasible() if self.options.mutation == "adaptive_feasible" else _Gaussian(generations)
        if np.ceil(self.options.elite * count) + 2 > count:
            raise ConfigError(f"genetic: an elite of {self.options.elite:g} leaves no children in {count}; lower it")
        people: Array = problem.rng.uniform(size=(count, variables))
        people[0] = problem.to_unit(problem.start)[0]  # the paper starts from the theoretical matrix
        scores = _scores(problem, people)
        best = [float(scores.min())]
        for _ in range(generations):
            people, scores = self._next_generation(problem, people, scores, mutate)
            best.append(float(scores.min()))
            mutate.adapt(improved=best[-1] < best[-2])
            if self._stalled(best):
                reason = f"best changed by {self.options.tolerance:g} or less on average over "
                return Solution(problem.best_vector, f"{reason}{self.options.stall_generations} generations")
        return Solution(problem.best_vector, f"{generations} generations", converged=False)

    def _next_generation(
        self, problem: CalibrationProblem, people: Array, scores: Array, mutate: _Mutation
    ) -> tuple[Array, Array]:
        """Elite, crossed and mutated children (count, f) and their costs (count,)."""
        count, rng = len(people), problem.rng
        elite = max(1, int(np.ceil(self.options.elite * count)))
        crossed = round(self.options.crossover * (count - elite))
        mutated = count - elite - crossed
        parents = people[_select(scores, 2 * crossed + mutated, rng)]
        mothers, fathers, singles = np.split(parents, [crossed, 2 * crossed])
        children = np.where(rng.random(mothers.shape) < 0.5, mothers, fathers)
        newcomers = np.concatenate([children, mutate(singles, rng)])
        survivors = np.argsort(scores, kind="stable")[:elite]
        return (
            np.concatenate([people[survivors], newcomers]),
            np.concatenate([scores[survivors], _scores(problem, newcomers)]),
        )

    def _stalled(self, best: list[float]) -> bool:
        """True if the best costs of the last generations changed by the tolerance or less on average."""
        window = best[-self.options.stall_generations - 1 :]
        if len(window) <= self.options.stall_generations or not np.isfinite(window).all():
            return False
        change = np.abs(np.diff(window)) / np.maximum(np.abs(window[1:]), np.finfo(float).tiny)
        return float(change.mean()) <= self.options.tolerance


class _AdaptiveFeasible:
    """Steps in random directions; the step grows after a success, shrinks after a failure and stays in the box."""

    def __init__(self) -> None:
        self.step = 1.0

    def __call__(self, parents: Array, rng: np.random.Generator) -> Array:
        directions = rng.standard_normal(parents.shape)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(directions > 0, (1 - parents) / directions, -parents / directions)
        longest = np.nanmin(np.where(directions == 0, np.inf, room), axis=1, keepdims=True)
        moved = parents + directions * np.minimum(self.step, longest)
        return np.clip(moved, 0.0, 1.0)

    def adapt(self, improved: bool) -> None:
        self.step = min(1.0, self.step * 4) if improved else max(_SMALLEST_STEP, self.step / 4)


class _Gaussian:
    """Normal steps of every element, whose width shrinks to nothing over the generations."""

    def __init__(self, generations: int) -> None:
        self._shrink = 1.0 / generations
        self._width = 1.0

    def __call__(self, parents: Array, rng: np.random.Generator) -> Array:
        return np.clip(parents + self._width * rng.standard_normal(parents.shape), 0.0, 1.0)

    def adapt(self, improved: bool) -> None:  # noqa: ARG002 (the schedule is fixed)
        self._width = max(0.0, self._width - self._shrink)


_Mutation = _AdaptiveFeasible | _Gaussian


def _scores(problem: CalibrationProblem, points: Array) -> Array:
    """Costs (P,) of points (P, f) of the unit cube; infinity for those that cannot be evaluated."""
    costs = problem.cost(problem.from_unit(points))
    return np.where(np.isfinite(costs), costs, np.inf)


def _select(scores: Array, count: int, rng: np.random.Generator) -> Array:
    """Stochastic uniform selection on rank scaling: equal steps along a line of sections 1/sqrt(rank)."""
    ranks = np.empty(len(scores))
    ranks[np.argsort(scores, kind="stable")] = np.arange(1, len(scores) + 1)
    edges = np.cumsum(1 / np.sqrt(ranks))
    marks = (rng.random() + np.arange(count)) / count * edges[-1]
    chosen = np.minimum(np.searchsorted(edges, marks), len(scores) - 1)
    return rng.permutation(chosen)
