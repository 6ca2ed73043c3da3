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
        options, rng = self.options, problem.rng
        variables = int(problem.free.sum())
        count = options.size(variables)
        generations = options.generations or 100 * variables
        elite = int(np.ceil(options.elite * count))
        if elite + 2 > count:
            raise ConfigError(f"genetic: an elite of {options.elite:g} leaves no children in {count}; lower it")
        crossed = round(options.crossover * (count - elite))
        people: Array = rng.uniform(size=(count, variables))
        people[0] = problem.to_unit(problem.start)[0]  # the paper starts from the theoretical matrix
        scores, step = _scores(problem, people), 1.0
        best = [float(scores.min())]
        for _ in range(generations):
            # The next generation: the elite, crossed children and mutated ones.
            parents = people[_select(scores, 2 * crossed + count - elite - crossed, rng)]
            mothers, fathers, singles = np.split(parents, [crossed, 2 * crossed])
            children = np.where(rng.random(mothers.shape) < 0.5, mothers, fathers)
            feasible = options.mutation == "adaptive_feasible"
            directions = rng.standard_normal(singles.shape)
            lengths: Array | float = step
            if feasible:  # in a random direction, at most as far as the unit cube reaches
                directions /= np.linalg.norm(directions, axis=1, keepdims=True)
                with np.errstate(divide="ignore", invalid="ignore"):
                    room = np.where(directions > 0, (1 - singles) / directions, -singles / directions)
                longest = np.nanmin(np.where(directions == 0, np.inf, room), axis=1, keepdims=True)
                lengths = np.minimum(step, longest)
            moved = singles + lengths * directions
            newcomers = np.concatenate([children, np.clip(moved, 0.0, 1.0)])
            survivors = np.argsort(scores, kind="stable")[:elite]
            people = np.concatenate([people[survivors], newcomers])
            scores = np.concatenate([scores[survivors], _scores(problem, newcomers)])
            best.append(float(scores.min()))
            # The step grows after a success and shrinks after a failure; the normal one follows a schedule.
            if feasible:
                step = min(1.0, step * 4) if best[-1] < best[-2] else max(_SMALLEST_STEP, step / 4)
            else:
                step = max(0.0, step - 1.0 / generations)
            window = np.array(best[-options.stall_generations - 1 :])
            if len(window) > options.stall_generations and np.isfinite(window).all():
                change = np.abs(np.diff(window)) / np.maximum(np.abs(window[1:]), np.finfo(float).tiny)
                if change.mean() <= options.tolerance:
                    reason = f"best changed by {options.tolerance:g} or less on average over "
                    return Solution(problem.best_vector, f"{reason}{options.stall_generations} generations")
        return Solution(problem.best_vector, f"{generations} generations", converged=False)


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
