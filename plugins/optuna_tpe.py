"""Optuna's tree-structured Parzen estimator: Bergstra et al., NeurIPS 24:2546 (2011)."""

import numpy as np
from numpy.random import Generator

from omnibench.fit.library_search import LibrarySearch, UnitCost
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array


@calibrators.register("optuna_tpe")
class OptunaTpe(LibrarySearch):
    """TPE by Optuna, asked for a candidate and told its cost; it slows down with every one, and ends after 500."""

    package = "optuna"

    def search(self, cost: UnitCost, start: Array, rng: Generator) -> str:
        """Optuna is asked and told."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=int(rng.integers(2**31))))
        for _ in range(500):
            trial = study.ask()
            point = np.array([trial.suggest_float(str(number), 0, 1) for number in range(len(start))])
            study.tell(trial, float(cost(point)[0]))
        return "500 evaluations"
