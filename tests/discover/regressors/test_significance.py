"""Significance, corrected for all groups that were tried."""

from __future__ import annotations

import numpy as np
from scipy.stats import binomtest

from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.significance import significance_of
from omnibench.fit.least_squares.whitened import Whitened

GROUPS = tuple(Group("covariate", f"group {start}", tuple(range(start, start + 2))) for start in range(2, 22, 2))


def data_of(residuals: list[np.ndarray], columns: list[np.ndarray]) -> Whitened:
    return Whitened(
        tuple(residuals),
        tuple(columns),
        np.sum([each.T @ each for each in columns], axis=0),
        np.array([each.T @ own for each, own in zip(columns, residuals, strict=True)]),
    )


def noise(seed: int, runs: int = 40) -> tuple[list[np.ndarray], list[np.ndarray], np.random.Generator]:
    """Heavy-tailed residuals that are correlated within runs, as no noise model says."""
    rng = np.random.default_rng(seed)
    residuals = [rng.standard_t(3, 12) + rng.normal() for _ in range(runs)]
    return residuals, [rng.normal(size=(12, 22)) for _ in range(runs)], rng


def test_noise_of_any_kind_is_surprising_as_often_as_its_p_value_says() -> None:
    seen = []
    for seed in range(200):
        residuals, columns, rng = noise(seed)
        found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
        seen.append(found.p_value(found.best) < 0.1)
    assert binomtest(sum(seen), len(seen), 0.1, alternative="greater").pvalue > 1e-3


def test_an_effect_in_every_run_is_found_in_its_group() -> None:
    residuals, columns, rng = noise(1)
    residuals = [own + each[:, 6] for own, each in zip(residuals, columns, strict=True)]
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.groups[found.best].name == "group 6"
    assert found.p_value(found.best) < 1e-6


def test_one_run_that_went_wrong_is_no_effect() -> None:
    residuals, columns, rng = noise(2)
    residuals[7] = residuals[7] + 40 * columns[7][:, 6]
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.chi_square.max() > 100
    assert found.p_value(found.best) > 0.01


def test_what_depends_on_few_runs_is_found_where_these_agree() -> None:
    residuals, columns, rng = noise(3)
    for run in range(5):
        residuals[run] = residuals[run] + 8 * columns[run][:, 6]
    for each in columns[5:]:
        each[:, 6:8] = 0.0
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.groups[found.best].name == "group 6"
    assert found.p_value(found.best) < 1e-3
