"""The odometry model that a calibrator fits and the live node runs: matrix, integration and effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from omnibench.robot.corrected import check_needs, needs_of
from omnibench.robot.effect_stream import EffectStream
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect
from omnibench.robot.effects.term import Term
from omnibench.robot.fade import Fade, faded_twists
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryBatch, OdometryStream, WheelLog
from omnibench.robot.path import Path
from omnibench.robot.signals import SignalStream, signals_of


@dataclass(frozen=True, eq=False)
class OdometryModel:
    """A robot's odometry: ``matrix`` (3, M) in m and rad per rad, integration of a sample, and effects.

    terms: effects of any stage; those of stage actuator are for simulation and ignored here. sample_period: nominal, s;
    needed with effects. fade: how the corrections of effects of motion fade outside the training domain; None: not.
    """

    robot: Robot
    matrix: Array
    integration: Integration
    terms: tuple[Term, ...] = ()
    sample_period: float | None = None
    fade: Fade | None = None

    def __post_init__(self) -> None:
        if self.terms and self.sample_period is None:
            raise ValueError("a model with effects needs the sample period")

    @classmethod
    def of_design(cls, robot: Robot, integration: Integration) -> OdometryModel:
        """The model of the design values, Eq. (7) for the APR-02."""
        return cls(robot, robot.inverse_kinematic_matrix, integration)

    @cached_property
    def motion_terms(self) -> tuple[Term, ...]:
        """Terms of stage wheel, clock, body and world."""
        return tuple(term for term in self.terms if isinstance(term.effect, MotionEffect))

    @property
    def _corrects(self) -> bool:
        """True if a motion is not the matrix's alone: effects of motion act, or the matrix fades to the plain one."""
        return bool(self.motion_terms) or self.fade is not None

    @cached_property
    def reference_terms(self) -> tuple[Term, ...]:
        """Terms of stage reference."""
        return tuple(term for term in self.terms if isinstance(term.effect, ReferenceEffect))

    def poses(self, logs: Sequence[WheelLog]) -> list[Array]:
        """Odometry of each log at its stamps: a list of (S, 3) in m, m, rad. Effects of the reference are ignored.

        After the last sample the pose is constant. DataError in one line: a log lacks data that an effect needs.
        """
        if self._corrects:
            return [self._path(log).poses(log.stamps) for log in logs]
        if not logs:
            return []
        batch = OdometryBatch(logs, self.integration)
        poses = batch.poses(self.matrix[None])[0]
        return [poses[batch.trajectory == index] for index in range(len(logs))]

    def reported(self, logs: Sequence[WheelLog]) -> list[Array]:
        """Poses that the reference reports at each log's stamps: a list of (S, 3) in m, m, rad.

        They equal ``poses`` unless the model has effects of the reference. Then a pose is the odometry's at the time
        when it was taken: before t = 0 the start pose; after the last sample the robot continues with the mean rate of
        its last five samples. DataError as for ``poses``.
        """
        if not self.reference_terms:
            return self.poses(logs)
        return [reported_poses(self.reference_terms, log, self._path) for log in logs]

    def lengths(self, logs: Sequence[WheelLog]) -> list[Array]:
        """Distances driven along the path up to each log's stamps: a list of (S,) in m. DataError as for ``poses``."""
        return [self._path(log).lengths(log.stamps) for log in logs]

    def stream(
        self, start: Array | None = None, session: str | None = None, session_time: float = 0.0
    ) -> OdometryStream:
        """Odometry by this model one sample at a time, from a start pose (default: the origin).

        session: its name; None if it is unknown to the calibration. session_time: at the stream's start, s.
        """
        if not self._corrects:
            return OdometryStream(self.matrix, self.integration, start, self.robot.drive)
        assert self.sample_period is not None  # there are terms
        needs = needs_of(self.motion_terms)
        signals = SignalStream(self.robot, self.matrix, self.sample_period, session, session_time, needs=needs)
        return EffectStream(self.motion_terms, signals, self.integration, start, self.fade)

    def _path(self, log: WheelLog) -> Path:
        """The path of a log under the effects of motion."""
        durations = np.diff(log.times, prepend=0.0)[:, None]
        if not self._corrects:
            return Path(log.times, log.start, (log.signals @ self.matrix.T) * durations, self.integration)
        assert self.sample_period is not None  # there are terms
        check_needs(self.motion_terms, log)
        signals = signals_of(log, self.robot, self.matrix, self.sample_period, needs_of(self.motion_terms))
        twists, drift, _ = faded_twists(self.fade, self.motion_terms, signals, self.matrix)
        world = None if drift is None else drift * durations
        return Path(log.times, log.start, twists * durations, self.integration, world)


class PosesOfPath(Protocol):
    """A path: its poses (S, 3) at stamps (S,), s, in any order."""

    def poses(self, stamps: Array, /) -> Array: ...


def reported_poses(terms: Sequence[Term], log: WheelLog, path_of: Callable[[WheelLog], PosesOfPath]) -> Array:
    """Poses (S, 3) of a log as effects of the reference report them. path_of: the path that a log drives."""
    taken, heading_taken = log.stamps, log.stamps
    for term in terms:
        assert isinstance(term.effect, ReferenceEffect)
        of_position, of_heading = term.effect.delays(log.stamps, term.values)
        taken, heading_taken = taken - of_position, heading_taken - of_heading
    path = path_of(log.continued(max(taken.max(initial=0.0), heading_taken.max(initial=0.0))))
    poses = path.poses(taken)
    poses[:, 2] = path.poses(heading_taken)[:, 2]
    for term in terms:
        assert isinstance(term.effect, ReferenceEffect)
        poses = term.effect.reported(poses, log.start, term.values)
    return poses
