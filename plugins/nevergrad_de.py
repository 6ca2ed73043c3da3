"""Nevergrad's differential evolution: Rapin and Teytaud, Nevergrad (2018)."""

from numpy.random import Generator, RandomState

from omnibench.fit.library_search import LibrarySearch, UnitCost
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array


@calibrators.register("nevergrad_de")
class NevergradDe(LibrarySearch):
    """Differential evolution with a two-point crossover by nevergrad, asked for a candidate and told its cost."""

    package = "nevergrad"

    def search(self, cost: UnitCost, start: Array, rng: Generator) -> str:
        """Nevergrad is asked and told. (Its NGOpt builds models that take minutes on nine elements.)"""
        import nevergrad

        point = nevergrad.p.Array(init=start).set_mutation(sigma=1 / 6)
        point.random_state = RandomState(int(rng.integers(2**31)))
        point.set_bounds(0.0, 1.0)  # draws a state of NumPy's where there is none
        optimiser = nevergrad.optimizers.TwoPointsDE(point, budget=10_000)
        for _ in range(optimiser.budget):
            candidate = optimiser.ask()
            optimiser.tell(candidate, float(cost(candidate.value)[0]))
        return "10,000 evaluations"
