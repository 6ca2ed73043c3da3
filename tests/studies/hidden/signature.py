"""Signature of an effect: its changes of the training poses that no matrix can make, in units of the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.noise import Whitener
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

from .experiment import Run
from .form import Form, Make, Values
from .motion import COARSE, Correction, Grid

_STEP = 1e-3  # of the plausible size, for derivatives


class Sight:
    """How clearly effects are seen in some runs: differences of poses, whitened, without what the matrix absorbs."""

    def __init__(self, runs: Sequence[Run], matrix: Array, noise: Noise) -> None:
        self.grid, self._noise = Grid(runs, matrix, COARSE), noise
        self._still = self.grid.poses(Correction())

    def of(self, correction: Correction) -> Array:
        """The whitened signature (m,) of a correction, orthogonal to every change of the matrix."""
        return self.beyond_matrix(self.whitened(self.grid.poses(correction) - self._still))

    def whitened(self, residuals: Array) -> Array:
        """Residuals (s, 3) at all stamps, m, m, rad, as independent ones of unit variance (m,)."""
        white = np.zeros_like(residuals)
        for rows, whitener in self._groups:
            white[rows] = whitener(residuals[rows].transpose(1, 2, 0)).transpose(2, 0, 1)
        return white.ravel()

    def beyond_matrix(self, white: Array) -> Array:
        """The part of whitened residuals (m,) that no change of the matrix gives."""
        return white - self._absorbed @ (self._absorbed.T @ white)

    def columns(self, make: Make, values: Values, plausible: Mapping[str, float], seed: Sequence[int]) -> Array:
        """Derivatives (m, p) of the signature by the parameters of a form, each times its plausible size."""
        return np.column_stack([self._derivative(make, values, name, plausible[name], seed) for name in plausible])

    def _derivative(self, make: Make, values: Values, name: str, size: float, seed: Sequence[int]) -> Array:
        up, down = ({**values, name: values[name] + sign * _STEP * size} for sign in (1, -1))
        poses = [self.grid.poses(make(self.grid, each, np.random.default_rng(seed))) for each in (up, down)]
        return self.beyond_matrix(self.whitened((poses[0] - poses[1]) / (2 * _STEP)))

    @cached_property
    def _groups(self) -> list[tuple[NDArray[np.intp], Whitener]]:
        """Rows (runs, K) of runs with the same stamps, without that at 0, and what whitens them."""
        groups: dict[int, list[int]] = {}
        for index, run in enumerate(self.grid.runs):
            groups.setdefault(run.command.samples, []).append(index)
        found = []
        for members in groups.values():
            stamps = self.grid.runs[members[0]].stamps[1:]
            rows = self.grid.stamp_first[members][:, None] + 1 + np.arange(len(stamps))
            found.append((rows, Whitener(self._noise, stamps)))
        return found

    @cached_property
    def _absorbed(self) -> Array:
        """An orthonormal basis (m, 9) of what the matrix can do."""
        grid, columns = self.grid, []
        for row in range(3):
            for wheel in range(grid.matrix.shape[1]):
                body = np.zeros((len(grid.run), 3))
                body[:, row] = 1e-5 * grid.rates[:, wheel]
                columns.append(self.whitened(grid.poses(Correction(body=body)) - self._still) / 1e-5)
        basis: Array = np.linalg.qr(np.column_stack(columns))[0]
        return basis


def projected(sight: Sight, form: Form, shapes: Values, signature: Array) -> tuple[dict[str, float], float]:
    """The values of a catalogue form that come closest to a hidden signature, and the chi2 that they leave.

    shapes: of the parameters that are chosen. Gauss-Newton: a delay does not act quite linearly.
    """
    names, sizes = list(form.plausible), np.array(list(form.plausible.values()))
    chosen = {name: shapes[name] for name in form.shapes or {}}
    values = dict.fromkeys(names, 0.0) | chosen
    left = signature
    for _ in range(3):
        columns = sight.columns(form.matched, values, form.plausible, [0])
        step = np.linalg.lstsq(columns, left, rcond=1e-10)[0]
        values = {name: values[name] + change for name, change in zip(names, step * sizes, strict=True)} | chosen
        left = signature - sight.of(form.matched(sight.grid, values, np.random.default_rng(0)))
        if np.abs(step).max() < 1e-6:
            break
    return values, float(left @ left)
