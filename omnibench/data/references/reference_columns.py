"""References from columns of a table: times, values and standard deviations, of which a row needs only some."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from omnibench.data.references.run_references import AT_ONE_TIME, PLANAR, References
from omnibench.robot.kinematics import Array

NUMBERS = ("t0", "t1", "value", "value_x", "value_y", "sigma", "sigma_x", "sigma_y", "sigma_rate")


def references_of(kinds: NDArray[np.str_], numbers: Mapping[str, Array], *, start_known: bool = False) -> References:
    """The references of rows with a kind (R,) and numbers (R,) by NUMBERS, NaN where a cell is empty.

    An empty t1 becomes inf, the end of a run; an empty t0 -inf, its start, or t1 of what is measured at one time. The
    largest sigma_rate is that of the run.
    """
    planar, instant = np.isin(kinds, list(PLANAR)), np.isin(kinds, list(AT_ONE_TIME))
    t1 = np.where(np.isnan(numbers["t1"]), np.inf, numbers["t1"])
    t0 = np.where(np.isnan(numbers["t0"]), np.where(instant, t1, -np.inf), numbers["t0"])
    both = numbers["sigma"]
    values = np.column_stack([np.where(planar, numbers["value_x"], numbers["value"]), numbers["value_y"]])
    sigmas = np.column_stack(
        [np.where(planar, _filled(numbers["sigma_x"], both), both), _filled(numbers["sigma_y"], both)]
    )
    values[~planar, 1] = sigmas[~planar, 1] = np.nan
    rates = np.append(np.nan_to_num(numbers["sigma_rate"]), 0.0)
    return References(kinds, t0, t1, values, sigmas, start_known, float(rates[np.abs(rates).argmax()]))


def _filled(values: Array, others: Array) -> Array:
    return np.where(np.isnan(values), others, values)
