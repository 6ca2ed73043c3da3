"""Motion of a robot of known truth: midpoint steps of a millisecond, of all runs at once.

Nothing here is shared with the odometry that the exam is about: other signals, another step, another rule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from omnibench.robot.kinematics import Array, wheel_equations

from .experiment import RAMP, ROBOT, SAMPLE, Run

T = TypeVar("T", Array, "Correction")
FINE = 10  # steps a sample: 1 ms
COARSE = 2  # enough to find how large an effect has to be


@dataclass(frozen=True, eq=False)
class Correction:
    """What is hidden does, at the steps (n) of all runs and at their reference stamps (s).

    wheel (n, N): rad/s. body (n, 3): m/s, m/s, rad/s. world (n, 2): m/s. delay, heading_delay (s): s, of the pose and,
    beyond that, of its heading. reported: what becomes of the true poses (s, 3). asked: what the motors
    had been told beyond the rates that they drove (n, N), rad/s. chance: what comes on top by chance, as jitter does:
    it is recorded, and counts as noise.
    """

    wheel: Array | None = None
    body: Array | None = None
    world: Array | None = None
    delay: Array | None = None
    heading_delay: Array | None = None
    reported: Callable[[Array], Array] | None = None
    asked: Array | None = None
    chance: Correction | None = None

    def __add__(self, other: Correction) -> Correction:
        first, second = self.reported, other.reported
        both = (lambda poses: second(first(poses))) if first and second else first or second
        return Correction(
            wheel=_sum(self.wheel, other.wheel),
            body=_sum(self.body, other.body),
            world=_sum(self.world, other.world),
            delay=_sum(self.delay, other.delay),
            heading_delay=_sum(self.heading_delay, other.heading_delay),
            reported=both,
            asked=_sum(self.asked, other.asked),
            chance=_sum(self.chance, other.chance),
        )


def _sum(first: T | None, second: T | None) -> T | None:
    if first is None or second is None:
        return second if first is None else first
    return first + second


class Grid:
    """The steps of all runs, one after another, and what a robot without any effect does at their middles.

    n steps, s reference stamps, N wheels. run (n,), stamp_run (s,): numbers of the runs. elapsed (n,): s since the
    run's start. rates (n, N), angular_accelerations (n, N): rad/s, rad/s2. stamps (s,): s, with that at 0.
    """

    def __init__(self, runs: Sequence[Run], matrix: Array, steps: int = FINE) -> None:
        self.runs, self.matrix, self.step = tuple(runs), matrix, SAMPLE / steps
        counts = np.array([run.command.samples * steps for run in runs])
        self.first = np.concatenate([[0], np.cumsum(counts)])  # where a run's steps begin
        self.run = np.repeat(np.arange(len(runs)), counts)
        self.elapsed = (np.arange(len(self.run)) - self.first[self.run] + 0.5) * self.step
        self.ends = counts * self.step
        asked = np.array([wheel_equations(ROBOT.wheels) @ run.command.twist for run in runs])
        left = self.ends[self.run] - self.elapsed
        share = np.minimum(np.minimum(self.elapsed, left) / RAMP, 1.0)
        slope = np.where(self.elapsed < RAMP, 1.0, np.where(left < RAMP, -1.0, 0.0)) / RAMP
        self.rates = asked[self.run] * share[:, None]
        self.angular_accelerations = asked[self.run] * slope[:, None]
        self.stamp_first = np.concatenate([[0], np.cumsum([len(run.stamps) for run in runs])])
        self.stamp_run = np.repeat(np.arange(len(runs)), np.diff(self.stamp_first))
        self.stamps = np.concatenate([run.stamps for run in runs])

    def of_run(self, values: Sequence[float] | Array) -> Array:
        """Values (R, ...) of the runs, at every step (n, ...)."""
        return np.asarray(values)[self.run]

    @cached_property
    def angles(self) -> Array:
        """Absolute wheel angles (n, N), rad."""
        start = np.array([run.angles for run in self.runs])
        return start[self.run] + self._until_middle(self.rates)

    @cached_property
    def twist(self) -> Array:
        """(n, 3): m/s, m/s, rad/s."""
        return self.rates @ self.matrix.T

    @cached_property
    def speed(self) -> Array:
        """(n,), m/s."""
        return np.hypot(self.twist[:, 0], self.twist[:, 1])

    @cached_property
    def acceleration(self) -> Array:
        """Derivative of the body velocity (n, 2), m/s2."""
        return self.angular_accelerations @ self.matrix[:2].T

    @cached_property
    def centripetal(self) -> Array:
        """w x v (n, 2), m/s2."""
        vx, vy, w = self.twist.T
        return np.column_stack([-w * vy, w * vx])

    @cached_property
    def travelled(self) -> Array:
        """Distance since the start of the run (n,), m."""
        return self._until_middle(self.speed[:, None])[:, 0]

    @cached_property
    def session_time(self) -> Array:
        """(n,), s."""
        return self.of_run([run.started_at for run in self.runs]) + self.elapsed

    @cached_property
    def heading(self) -> Array:
        """World heading without an effect (n,), rad."""
        return self._starts[self.run, 2] + self._until_middle(self.twist[:, 2:])[:, 0]

    @cached_property
    def place(self) -> Array:
        """World position without an effect (n, 2), m."""
        return self._starts[self.run, :2] + self._until_middle(_rotated(self.twist[:, :2], self.heading))

    def poses(self, correction: Correction) -> Array:
        """Reference poses (s, 3) without noise, at every stamp, of a robot with this correction."""
        rates = self.rates if correction.wheel is None else self.rates + correction.wheel
        twist = rates @ self.matrix.T
        if correction.body is not None:
            twist = twist + correction.body
        heading = self._starts[self.run, 2] + self._until_middle(twist[:, 2:])[:, 0]
        velocity = _rotated(twist[:, :2], heading)
        if correction.world is not None:
            velocity = velocity + correction.world
        path = np.vstack([np.zeros(3), self._ends(np.column_stack([velocity, twist[:, 2]]))])
        at = self.stamps if correction.delay is None else self.stamps - correction.delay
        later = at if correction.heading_delay is None else at - correction.heading_delay
        poses = (
            np.column_stack([self._at(path[:, :2], at), self._at(path[:, 2:], later)]) + self._starts[self.stamp_run]
        )
        return poses if correction.reported is None else correction.reported(poses)

    def sample_means(self, values: Array) -> Array:
        """Means (F of all runs, N) of values at the steps (n, N), over every wheel sample."""
        steps = round(SAMPLE / self.step)
        return values.reshape(-1, steps, values.shape[1]).mean(axis=1)

    @cached_property
    def _starts(self) -> Array:
        return np.array([run.start for run in self.runs])

    def _ends(self, rates: Array) -> Array:
        """Integrals (n, m) up to the end of every step, over all runs: only differences within a run mean anything."""
        return np.cumsum(rates, axis=0) * self.step

    def _until_middle(self, rates: Array) -> Array:
        """Integrals (n, m) from the start of the run to the middle of every step."""
        ends = self._ends(rates)
        before = np.vstack([np.zeros(rates.shape[1]), ends])[self.first[:-1]]
        return ends - 0.5 * self.step * rates - before[self.run]

    def _at(self, path: Array, times: Array) -> Array:
        """A path (n + 1, m) since the run's start, at a time (s,) for each stamp; the robot stands before and after."""
        within = np.clip(times, 0.0, self.ends[self.stamp_run]) / self.step
        last = self.first[self.stamp_run + 1] - self.first[self.stamp_run] - 1
        whole = np.minimum(np.floor(within + 1e-9).astype(int), last)
        share = np.clip(within - whole, 0.0, 1.0)[:, None]
        row = self.first[self.stamp_run] + whole
        return path[row] + share * (path[row + 1] - path[row]) - path[self.first[self.stamp_run]]


def _rotated(vectors: Array, angle: Array) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.column_stack(
        [cosine * vectors[:, 0] - sine * vectors[:, 1], sine * vectors[:, 0] + cosine * vectors[:, 1]]
    )
