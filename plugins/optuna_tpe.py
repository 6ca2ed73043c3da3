"""Optuna's tree-structured Parzen estimator: Bergstra et al., NeurIPS 24:2546 (2011)."""

from omnibench.fit.library_search import LibrarySearch
from omnibench.registry import calibrators


@calibrators.register("optuna_tpe")
class OptunaTpe(LibrarySearch):
    """TPE by Optuna, asked for a candidate and told its cost; it slows down with every one, and ends after 500."""

    package = "optuna"

    def search(self, cost, start, rng):
        """Optuna is asked and told."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=int(rng.integers(2**31))))
        for _ in range(500):
            trial = study.ask()
            study.tell(trial, float(cost([trial.suggest_float(str(i), 0, 1) for i in range(len(start))])[0]))
        return "500 evaluations"
