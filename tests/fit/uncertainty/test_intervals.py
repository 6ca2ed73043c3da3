"""Half-widths of intervals by Student's t, against values of printed tables and small matrices."""

from __future__ import annotations

import numpy as np
import pytest

from omnibench.fit.information import EstimatedCovariance

MATRIX = np.array([[4.0, 1.0], [1.0, 9.0]])


def test_half_widths_are_students_quantiles_times_the_standard_deviations() -> None:
    covariance = EstimatedCovariance(MATRIX, np.array([3.0, 10.0]))
    np.testing.assert_allclose(covariance.reach, [3.182 * 2, 2.228 * 3], rtol=2e-4)


def test_a_known_covariance_has_the_normal_quantile() -> None:
    np.testing.assert_allclose(EstimatedCovariance(MATRIX).reach, [1.960 * 2, 1.960 * 3], rtol=2e-4)


def test_one_number_of_degrees_of_freedom_holds_for_all_functions() -> None:
    functions = EstimatedCovariance(MATRIX, 5).of(np.array([[1.0, 1.0], [2.0, -1.0]]))
    np.testing.assert_allclose(functions.matrix, [[15.0, 0.0], [0.0, 21.0]], atol=1e-12)
    np.testing.assert_allclose(functions.degrees_of_freedom, 5.0)


def test_the_degrees_of_freedom_of_a_sum_lie_between_those_of_its_terms() -> None:
    independent = EstimatedCovariance(np.diag([1.0, 3.0]), np.array([2.0, 6.0]))
    functions = independent.of(np.array([[1.0, 0.0], [1.0, 1.0]]))
    assert functions.degrees_of_freedom == pytest.approx([2.0, 1 / (0.25 / 2 + 0.75 / 6)])


def test_functions_of_nothing_that_varies_have_no_width() -> None:
    kept = EstimatedCovariance(np.zeros((2, 2)), np.array([1.0, 4.0])).of(np.ones((1, 2)))
    assert kept.reach == pytest.approx([0.0])
