"""Unknown start poses of runs in the frame of their positions and headings: likeliest values, and what moves them.

Let q_i be the odometry's positions from the origin, f_k its headings, z_i and h_k what was measured, with the weights
u_i, v_i (of x and y) and w_k. The start (p, s) minimises

    F = 1/2 sum_i |p + R(s) q_i - z_i|^2_(u, v) + 1/2 sum_k w_k (s + f_k - h_k)^2.                        (1)

For a given s the likeliest p makes the weighted means of x and y agree, so that q and z count from their means, x and y
each with its own weights. With c = cos s, n = sin s and sums such as A_xx = sum u q_x^2, what is left is

    F(s) = 1/2 (c^2 A + n^2 B - 2 c n C) - c a + n b + 1/2 W s^2 - s d + const,                           (2)

of one variable: the lowest of a grid, then Newton's steps. Its derivatives by the q and f are those of an implicit
function, F_ss ds = -dF_s.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

_GRID = 16  # headings among which Newton's steps begin: Eq. (2) has two waves a turn
_STEPS = 12  # Newton's steps; four settle
_FARTHEST, _SETTLED = 0.3, 1e-13  # rad: the longest step, and one that is rounding
_LEAST = 1e-12  # share of the weights: less curvature is rounding, and the heading is not determined


@dataclass(frozen=True, eq=False)
class StartPoses:
    """The profile of the start poses of Z runs, numbered from 0.

    placed (I,), headed (J,): their positions and headings among all rows; of_placed (I,), of_headed (J,): the run of
    each. positions (I, 2), headings (J,): what was measured. position_weights (I, 2), heading_weights (J,): 1/sigma^2.
    """

    count: int
    placed: NDArray[np.intp]
    headed: NDArray[np.intp]
    of_placed: NDArray[np.intp]
    of_headed: NDArray[np.intp]
    positions: Array
    headings: Array
    position_weights: Array
    heading_weights: Array

    @property
    def spread(self) -> Array:
        """Squares (Z,) of the measured positions about their means and of heading's information, in units of sigma."""
        squares = self.position_weights * np.square(self._centred(self.positions))
        return self._sum_placed(squares.sum(axis=1)) + self._sum_headings(self.heading_weights)

    def fitted(self, positions: Array, headings: Array) -> tuple[Array, Array]:
        """Positions (P, I, 2) and headings (P, J) of odometry from the origin, seen from the likeliest starts."""
        turns = self.turns(positions, headings)
        of_positions = turns[:, self.of_placed]
        cosine, sine = np.cos(of_positions), np.sin(of_positions)
        x, y = positions[..., 0], positions[..., 1]
        moved = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
        errors = moved - self.positions
        for axis in range(2):
            errors[..., axis] -= self._means(errors[..., axis], axis)
        return self.positions + errors, headings + turns[:, self.of_headed]

    def slopes(self, positions: Array, headings: Array, moving: Array, turning: Array) -> tuple[Array, Array]:
        """Derivatives (I, 2, n) and (J, n) of what ``fitted`` gives for one candidate.

        moving (I, 2, n), turning (J, n): those of positions (I, 2) and headings (J,).
        """
        turns = self.turns(positions[None], headings[None])[0]
        cosine, sine = np.cos(turns[self.of_placed]), np.sin(turns[self.of_placed])
        rotation = np.array([[cosine, -sine], [sine, cosine]])  # (2, 2, I)
        quarter = np.array([[-sine, -cosine], [cosine, -sine]])  # its derivative by the heading
        path = np.einsum("abi,ib->ia", rotation, positions)
        errors, centred = self._centred(path - self.positions), self._centred(path)
        by_turn = self._centred(np.einsum("abi,ib->ia", quarter, positions))
        direct = self._centred(np.einsum("abi,ibn->ian", rotation, moving))
        turned = self._centred(np.einsum("abi,ibn->ian", quarter, moving))
        weights = self.position_weights
        bend = (weights * (np.square(by_turn) - errors * centred)).sum(axis=1)
        of_headings = self._sum_headings(self.heading_weights)
        curvature = self._sum_placed(bend) + of_headings
        total = self._sum_placed((weights * np.square(centred)).sum(axis=1)) + of_headings
        by_positions = (weights * by_turn)[..., None] * direct + (weights * errors)[..., None] * turned
        change = self._sum_placed(by_positions.sum(axis=1).T) + self._sum_headings(self.heading_weights * turning.T)
        known = curvature > _LEAST * total
        by_candidate = np.where(known, -change / np.where(known, curvature, 1.0), 0.0).T  # (Z, n)
        of_positions = direct + by_turn[..., None] * by_candidate[self.of_placed][:, None]
        return of_positions, turning + by_candidate[self.of_headed]

    def turns(self, positions: Array, headings: Array) -> Array:
        """Likeliest start headings (P, Z), Eq. (2)."""
        u, v = self.position_weights[:, 0], self.position_weights[:, 1]
        along = [self._about(positions[..., axis], 0) for axis in range(2)]
        across = [self._about(positions[..., axis], 1) for axis in range(2)]
        seen_x, seen_y = self._about(self.positions[:, 0], 0), self._about(self.positions[:, 1], 1)
        a_term = self._sum_placed(u * along[0] ** 2 + v * across[1] ** 2)
        b_term = self._sum_placed(u * along[1] ** 2 + v * across[0] ** 2)
        mixed = self._sum_placed(u * along[0] * along[1] - v * across[0] * across[1])
        forward = self._sum_placed(u * along[0] * seen_x + v * across[1] * seen_y)
        sideways = self._sum_placed(u * along[1] * seen_x - v * across[0] * seen_y)
        weight = self._sum_headings(self.heading_weights)
        pull = self._sum_headings((self.headings - headings) * self.heading_weights)

        def value(turn: Array) -> Array:
            c, n = np.cos(turn), np.sin(turn)
            waves: Array = (c**2 * a_term + n**2 * b_term) / 2 - c * n * mixed - c * forward + n * sideways
            return waves + weight * turn**2 / 2 - turn * pull

        middle = pull / np.where(weight > 0, weight, 1.0)
        grid = np.append(np.linspace(-np.pi, np.pi, _GRID, endpoint=False), 0.0)
        tries = middle + grid[:, None, None]
        turn = np.take_along_axis(tries, np.argmin(value(tries), axis=0)[None], axis=0)[0]
        for _ in range(_STEPS):
            c, n = np.cos(turn), np.sin(turn)
            slope = c * n * (b_term - a_term) - (c**2 - n**2) * mixed + n * forward + c * sideways
            slope += weight * turn - pull
            bend = (c**2 - n**2) * (b_term - a_term) + 4 * c * n * mixed + c * forward - n * sideways + weight
            step = np.where(bend > 0, slope / np.maximum(bend, np.finfo(float).tiny), 0.0)
            turn = turn - np.maximum(np.minimum(step, _FARTHEST), -_FARTHEST)
            if np.abs(step).max(initial=0.0) < _SETTLED:
                break
        return turn

    def _sum_placed(self, values: Array) -> Array:
        """Sums (..., Z) of values (..., I) over the positions of each run."""
        sums: Array = values @ self._indicators[0]
        return sums

    def _sum_headings(self, values: Array) -> Array:
        """Sums (..., Z) of values (..., J) over the headings of each run."""
        sums: Array = values @ self._indicators[1]
        return sums

    @cached_property
    def _indicators(self) -> tuple[Array, Array]:
        """1 where a position (I, Z), and a heading (J, Z), is of a run."""
        runs = np.arange(self.count)
        return (self.of_placed[:, None] == runs).astype(float), (self.of_headed[:, None] == runs).astype(float)

    def _means(self, values: Array, axis: int) -> Array:
        """Values (..., I) replaced by their run's mean with the weights of x (axis 0) or y (1)."""
        weights = self.position_weights[:, axis]
        totals = np.maximum(self._sum_placed(weights), np.finfo(float).tiny)
        means: Array = (self._sum_placed(values * weights) / totals)[..., self.of_placed]
        return means

    def _about(self, values: Array, axis: int) -> Array:
        """Values (..., I) less their run's mean with the weights of x (axis 0) or y (1)."""
        about: Array = values - self._means(values, axis)
        return about

    def _centred(self, values: Array) -> Array:
        """Values (I, 2) or (I, 2, n) less their run's means, those of x with the weights of x, of y with y's."""
        parts = [np.moveaxis(self._about(np.moveaxis(values[:, axis], 0, -1), axis), -1, 0) for axis in range(2)]
        return np.stack(parts, axis=1)
