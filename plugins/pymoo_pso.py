"""Particle swarm optimisation by pymoo: Kennedy and Eberhart, Proc. ICNN 4:1942 (1995)."""

from numpy.random import Generator

from omnibench.fit.library_search import LibrarySearch, UnitCost
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array


@calibrators.register("pymoo_pso")
class PymooPso(LibrarySearch):
    """Particle swarm, whole generations at once, by pymoo."""

    package = "pymoo"

    def search(self, cost: UnitCost, start: Array, rng: Generator) -> str:
        """Pymoo calls a function of whole generations."""
        from pymoo.algorithms.soo.nonconvex.pso import PSO
        from pymoo.optimize import minimize
        from pymoo.problems.functional import FunctionalProblem

        problem = FunctionalProblem(len(start), [lambda point: float(cost(point)[0])], xl=0.0, xu=1.0)
        minimize(problem, PSO(), seed=int(rng.integers(2**31)))
        return "its own rule of termination"
