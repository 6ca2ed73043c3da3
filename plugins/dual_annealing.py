"""SciPy's dual annealing: Xiang et al., Physics Letters A 233:216 (1997)."""

from numpy.random import Generator

from omnibench.fit.library_search import LibrarySearch, UnitCost
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array


@calibrators.register("dual_annealing")
class DualAnnealing(LibrarySearch):
    """Generalised simulated annealing with a local search, by SciPy."""

    package = "scipy"

    def search(self, cost: UnitCost, start: Array, rng: Generator) -> str:
        """SciPy calls a function of one point."""
        from scipy.optimize import dual_annealing

        box = [(0.0, 1.0)] * len(start)
        return dual_annealing(lambda point: float(cost(point)[0]), box, x0=start, rng=rng).message[0]
