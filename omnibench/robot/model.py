"""The odometry model that a calibrator fits and the live node runs: matrix, integration and effects."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from omnibench.robot.corrected import check_needs, needs_of
from omnibench.robot.domain.fade import Fade, faded_twists
from omnibench.robot.effect_stream import EffectStream
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryStream, RunSamples, WheelLog, split_by
from omnibench.robot.path import PathBatch
from omnibench.robot.signals import SignalStream, signals_of_runs
from omnibench.robot.stored.odometry_of_stored import StoredOdometry, are_many

_BLOCK = 30_000  # samples that are evaluated at once: 1,000 to 100,000 take within 10 % as long each


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
        if not self._corrects and are_many(logs) and all((np.diff(log.stamps) >= 0).all() for log in logs):
            of_all = StoredOdometry(logs, self.integration).poses(self.matrix[None])[0]
            return split_by(of_all, [log.stamps for log in logs])
        return self._of_paths(logs, PathBatch.poses)

    def reported(self, logs: Sequence[WheelLog]) -> list[Array]:
        """Poses that the reference reports at each log's stamps: a list of (S, 3) in m, m, rad.

        They equal ``poses`` unless the model has effects of the reference. Then a pose is the odometry's at the time
        when it was taken: before t = 0 the start pose; after the last sample the robot continues with the mean rate of
        its last five samples. DataError as for ``poses``.
        """
        return reported_poses(self.reference_terms, logs, self.poses) if self.reference_terms else self.poses(logs)

    def lengths(self, logs: Sequence[WheelLog]) -> list[Array]:
        """Distances driven along the path up to each log's stamps: a list of (S,) in m. DataError as for ``poses``."""
        return self._of_paths(logs, PathBatch.lengths)

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

    def _of_paths(
        self, logs: Sequence[WheelLog], quantity: Callable[[PathBatch, Sequence[Array]], list[Array]]
    ) -> list[Array]:
        """A quantity of the path of each log at the log's stamps."""
        values: list[Array] = [np.empty(0)] * len(logs)
        for together in _blocks(logs):
            part = [logs[index] for index in together]
            of_part = quantity(self._paths(part), [log.stamps for log in part])
            for index, of_log in zip(together, of_part, strict=True):
                values[index] = of_log
        return values

    def _paths(self, logs: Sequence[WheelLog]) -> PathBatch:
        """The paths of the logs of one session under the effects of motion."""
        samples, starts = RunSamples.of([log.times for log in logs]), np.array([log.start for log in logs])
        durations = samples.durations[:, None]
        if not self._corrects:
            driven = np.concatenate([log.signals for log in logs])
            return PathBatch(samples, starts, (driven @ self.matrix.T) * durations, self.integration)
        assert self.sample_period is not None  # there are terms
        for log in logs:
            check_needs(self.motion_terms, log)
        needs = needs_of(self.motion_terms)
        signals = signals_of_runs(logs, samples, self.robot, self.matrix, self.sample_period, needs)
        twists, drift, _ = faded_twists(self.fade, self.motion_terms, signals, self.matrix)
        world = None if drift is None else drift * durations
        return PathBatch(samples, starts, twists * durations, self.integration, world)


def _blocks(logs: Sequence[WheelLog]) -> Iterator[list[int]]:
    """The logs of each session in blocks whose samples stay in the processor's cache."""
    sessions: dict[str | None, list[int]] = {}
    for index, log in enumerate(logs):
        sessions.setdefault(log.session, []).append(index)
    for members in sessions.values():
        block, count = list[int](), 0
        for index in members:
            if block and count + len(logs[index].times) > _BLOCK:
                yield block
                block, count = [], 0
            block.append(index)
            count += len(logs[index].times)
        yield block


def reported_poses(
    terms: Sequence[Term], logs: Sequence[WheelLog], poses_of: Callable[[Sequence[WheelLog]], list[Array]]
) -> list[Array]:
    """Poses (S, 3) of each log as effects of the reference report them.

    poses_of: the poses of the logs' paths at the logs' stamps, in any order of these.
    """
    taken = []
    for log in logs:
        of_position = of_heading = log.stamps
        for term in terms:
            assert isinstance(term.effect, ReferenceEffect)
            before = term.effect.delays(log.stamps, term.values)
            of_position, of_heading = of_position - before[0], of_heading - before[1]
        when = np.concatenate([of_position, of_heading])
        taken.append(replace(log.continued(when.max(initial=0.0)), stamps=when))
    reported = []
    for log, both in zip(logs, poses_of(taken), strict=True):
        poses = np.column_stack([both[: len(log.stamps), :2], both[len(log.stamps) :, 2]])
        for term in terms:
            assert isinstance(term.effect, ReferenceEffect)
            poses = term.effect.reported(poses, log.start, term.values)
        reported.append(poses)
    return reported
