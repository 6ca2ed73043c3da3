"""Paths of robots with constant twist within every sample, at any times: Eq. (1) and (2), or exact arcs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, RunSamples, chord_shares, split_by


class PathBatch:
    """The paths of Z runs, F samples in all, one run after another.

    starts (Z, 3): poses at t = 0. moved (F, 3): motion in the robot's frame, m, m, rad. drift (F, 2): further
    displacement in the reference's frame, m; None for none.
    """

    def __init__(
        self, samples: RunSamples, starts: Array, moved: Array, integration: Integration, drift: Array | None = None
    ) -> None:
        self._samples, self._arc, self._moved = samples, integration == "arc", moved
        self._drift: Complex | None = None if drift is None else drift[:, 0] + 1j * drift[:, 1]
        run = samples.run
        self._headings = starts[run, 2] + samples.before(samples.sums(moved[:, 2]))
        steps = self._steps(moved, self._headings)
        if self._drift is not None:
            steps += self._drift
        sums, places = samples.sums(steps), (starts[:, 0] + 1j * starts[:, 1])[run]
        self._positions: Complex = places + samples.before(sums)
        self._after: Complex = places + sums

    @cached_property
    def middles(self) -> Array:
        """Means (F, 3) of the poses before and after each sample."""
        places = (self._positions + self._after) / 2
        return np.column_stack([places.real, places.imag, self._headings + self._moved[:, 2] / 2])

    @property
    def ends(self) -> list[Array]:
        """Poses (F + 1, 3) of each run at its start and at the end of each sample."""
        before = np.column_stack([self._positions.real, self._positions.imag, self._headings])
        after = np.column_stack([self._after.real, self._after.imag, self._headings + self._moved[:, 2]])
        return [np.vstack([before[low : low + 1], after[low:high]]) for low, high in pairwise(self._samples.edges)]

    def poses(self, stamps: Sequence[Array]) -> list[Array]:
        """Poses (S, 3) of each run in m, m, rad at stamps (S,) in s, in any order; headings are not wrapped.

        Before t = 0 it is the start pose, after the last sample the pose at its end.
        """
        sample, share = self._samples.locate(stamps)
        piece = share[:, None] * self._moved[sample]
        heading = self._headings[sample]
        position = self._positions[sample] + self._steps(piece, heading)
        if self._drift is not None:
            position = position + share * self._drift[sample]
        poses = np.column_stack([position.real, position.imag, heading + piece[:, 2]])
        return split_by(poses, stamps)

    def lengths(self, stamps: Sequence[Array]) -> list[Array]:
        """Distances driven along each path, backwards too, up to stamps (S,) in s, in any order, m."""
        samples = self._samples
        sample, share = samples.locate(stamps)
        moved: Complex = self._moved[:, 0] + 1j * self._moved[:, 1]
        if self._drift is not None:
            moved = moved + self._drift * np.exp(-1j * self._headings)
        speeds = np.abs(moved)
        return split_by(samples.before(samples.sums(speeds))[sample] + share * speeds[sample], stamps)

    def _steps(self, moved: Array, headings: Array) -> Complex:
        """x + iy of motions (n, 3) that begin with headings (n,)."""
        turned = headings + moved[:, 2] / 2 if self._arc else headings
        cosine, sine = np.cos(turned), np.sin(turned)
        steps: Complex = np.empty(len(moved), dtype=complex)
        steps.real = moved[:, 0] * cosine - moved[:, 1] * sine
        steps.imag = moved[:, 0] * sine + moved[:, 1] * cosine
        if self._arc:
            steps *= chord_shares(moved[:, 2] / 2)
        return steps


class Path:
    """The path of one run of F samples, as ``PathBatch`` has it of many.

    times (F,): their ends, s. start (3,): pose at t = 0. moved (F, 3), drift (F, 2): as for ``PathBatch``.
    """

    def __init__(
        self, times: Array, start: Array, moved: Array, integration: Integration, drift: Array | None = None
    ) -> None:
        self._batch = PathBatch(RunSamples.of([times]), start[None], moved, integration, drift)

    def poses(self, stamps: Array) -> Array:
        """Poses (S, 3) in m, m, rad at stamps (S,) in s, in any order; headings are not wrapped."""
        return self._batch.poses([stamps])[0]
