"""Nevergrad's optimiser that chooses among its optimisers: Meunier et al., IEEE Trans. Evol. Comput. 26:490 (2022)."""

from numpy.random import Generator

from omnibench.fit.library_search import LibrarySearch, UnitCost
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array


@calibrators.register("nevergrad_ngopt")
class NevergradNgopt(LibrarySearch):
    """NGOpt by nevergrad, asked for a candidate and told its cost until the budget is spent."""

    package = "nevergrad"

    def search(self, cost: UnitCost, start: Array, rng: Generator) -> str:
        """Nevergrad is asked and told."""
        import nevergrad

        point = nevergrad.p.Array(init=start).set_bounds(0.0, 1.0)
        point.random_state.seed(int(rng.integers(2**31)))
        optimiser = nevergrad.optimizers.NGOpt(point, budget=10_000)
        for _ in range(optimiser.budget):
            candidate = optimiser.ask()
            optimiser.tell(candidate, float(cost(candidate.value)[0]))
        return "10,000 evaluations"
