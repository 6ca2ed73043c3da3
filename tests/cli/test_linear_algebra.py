"""Equations without a finite solution end in one line and exit code 2, wherever they come up."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from scipy.linalg.lapack import dtbtrs

import omnibench
from omnibench.__main__ import _run
from omnibench.errors import computable

UNKNOWN = np.full((3, 3), np.nan)


@pytest.mark.parametrize(
    "compute",
    [
        lambda: np.linalg.eigh(UNKNOWN),
        lambda: np.linalg.svd(UNKNOWN),
        lambda: np.linalg.inv(np.zeros((2, 2))),
        lambda: np.linalg.cholesky(-np.eye(2)),
        lambda: scipy.linalg.inv(UNKNOWN),
        lambda: dtbtrs(np.ones((2, 3)), np.ones((2, 1))),
    ],
    ids=["eigenvalues", "singular values", "inverse", "Cholesky factor", "SciPy", "LAPACK"],
)
def test_a_failure_of_linear_algebra_is_one_line(
    compute: Callable[[], object], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        _run(SimpleNamespace(main=lambda **_: compute()))
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: the equations have no finite solution; omnibench check DATASET says")


@pytest.mark.parametrize("name", ["calibrate", "check", "discover_effects", "evaluate"])
def test_from_python_it_is_one_of_the_errors_that_are_told(name: str) -> None:
    function = getattr(omnibench, name)
    assert function is not function.__wrapped__
    with pytest.raises(omnibench.OmnibenchError, match="no finite solution"):
        computable(lambda: np.linalg.inv(np.zeros((2, 2))))()


def test_other_mistakes_of_the_program_stay_visible() -> None:
    with pytest.raises(ValueError, match="broadcast"):
        _run(SimpleNamespace(main=lambda **_: np.zeros(2) + np.zeros(3)))
