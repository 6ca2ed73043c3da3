"""The odometry model that a calibrator fits and the live node runs: matrix, integration and effects.

``OdometryModel`` computes poses of whole runs; ``EffectStream`` one wheel sample at a time, with the same corrections.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from omnibench.robot.corrections import Fade, check_needs, faded_twists, needs_of
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryStream, PathBatch, RunSamples, WheelLog, advance
from omnibench.robot.signals import SignalStream, signals_of_runs
from omnibench.robot.stored_odometry import are_many, parts_of, poses_of_runs

# Chord by length of an arc. Below it the arc ends where it began, and no motion in the robot's frame displaces its end.
_NO_STRETCH = 1e-6
_BLOCK = 30_000  # samples that are evaluated at once: 1,000 to 100,000 take within 10 % as long each


class EffectStream(OdometryStream):
    """A stream whose samples are corrected by effects of stage wheel, clock, body and world.

    Effects that need poses get those of the uncorrected path, as in a batch. The path begins at the start, and again
    wherever ``pose`` is set from outside.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        signals: SignalStream,
        integration: Integration,
        start: Array | None = None,
        fade: Fade | None = None,
    ) -> None:
        super().__init__(signals.matrix, integration, start, signals.robot.drive)
        self._terms, self._signals, self._fade = tuple(terms), signals, fade
        self._needs_poses = any("poses" in term.effect.needs for term in self._terms)
        self._left_at: Array | None = None

    def drive(
        self,
        angles: Array,
        duration: float | None = None,
        wheel_angles: Array | None = None,
        steering: Array | None = None,
    ) -> Array:
        if duration is None:
            raise ValueError("a model with effects needs the duration of every sample")
        angles = np.asarray(angles, dtype=float)
        if self._needs_poses and self.pose is not self._left_at:  # the uncorrected path begins where the stream was put
            self._signals.pose = self.pose
        if duration <= 0:  # without rates no effect acts, and the matrix stands
            self.doubts = None
            self._signals.turn(angles, wheel_angles)
            self._left_at = super().drive(angles, steering=steering)
            self._signals.move(self.moved)
            return self.pose
        middle = self.steer(steering)
        steered = None if middle is None or steering is None else (middle, np.asarray(steering, dtype=float))
        self.driven = self.driven_signals(angles, middle)
        signals = self._signals.next(angles / duration, duration, wheel_angles, self.frame_heading, steered)
        twists, drift, doubts = faded_twists(self._fade, self._terms, signals, self.matrix)
        before, moved = self.pose, twists[0] * duration
        self.pose = advance(before, moved, self.integration)
        if drift is not None:
            # From the reference's frame to the stream's.
            turn = complex(math.cos(self.frame_heading), -math.sin(self.frame_heading))
            displaced = drift[0] * duration
            added = complex(displaced[0], displaced[1]) * turn
            self.pose = self.pose + np.array([added.real, added.imag, 0.0])
            # The motion in the robot's frame that displaces the end of the sample by that
            half = moved[2] / 2 if self.integration == "arc" else 0.0
            stretch = math.sin(half) / half if half else 1.0
            if abs(stretch) >= _NO_STRETCH:
                direction = before[2] + half
                in_body = added * complex(math.cos(direction), -math.sin(direction)) / stretch
                moved = moved + np.array([in_body.real, in_body.imag, 0.0])
        self.moved, self._left_at, self.doubts = moved, self.pose, None
        if doubts is not None:
            # From deviations (5, r) of twist and drift to those (3, r) of the motion in the robot's frame.
            deviations, heading = duration * doubts[0], self.frame_heading + before[2]
            cosine, sine = math.cos(heading), math.sin(heading)
            of_drift = np.array([[cosine, sine], [-sine, cosine], [0.0, 0.0]]) @ deviations[3:]
            self.doubts = deviations[:3] + of_drift
        return self.pose


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
        """The model of the design values, Eq. (7) of Palacin et al. 2023 for the APR-02."""
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
            return poses_of_runs(logs, self.matrix, self.integration)
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
        """A quantity of the path of each log, under the effects of motion, at the log's stamps."""
        values: list[Array] = [np.empty(0)] * len(logs)
        for together in _blocks(logs):
            part = [logs[index] for index in together]
            samples, world = RunSamples.of([log.times for log in part]), None
            durations = samples.durations[:, None]
            if self._corrects:
                assert self.sample_period is not None  # there are terms
                for log in part:
                    check_needs(self.motion_terms, log)
                needs = needs_of(self.motion_terms)
                signals = signals_of_runs(part, samples, self.robot, self.matrix, self.sample_period, needs)
                twists, drift, _ = faded_twists(self.fade, self.motion_terms, signals, self.matrix)
                world = None if drift is None else drift * durations
            else:
                twists = np.concatenate([log.signals for log in part]) @ self.matrix.T
            starts = np.array([log.start for log in part])
            paths = PathBatch(samples, starts, twists * durations, self.integration, world)
            for index, of_log in zip(together, quantity(paths, [log.stamps for log in part]), strict=True):
                values[index] = of_log
        return values


def _blocks(logs: Sequence[WheelLog]) -> Iterator[list[int]]:
    """The logs of each session in blocks whose samples stay in the processor's cache."""
    sessions: dict[str | None, list[int]] = {}
    for index, log in enumerate(logs):
        sessions.setdefault(log.session, []).append(index)
    for members in sessions.values():
        block, count = list[int](), 0
        for index in members:
            if block and count + logs[index].samples.count > _BLOCK:
                yield block
                block, count = [], 0
            block.append(index)
            count += logs[index].samples.count
        yield block


def reported_poses(
    terms: Sequence[Term], logs: Sequence[WheelLog], poses_of: Callable[[Sequence[WheelLog]], list[Array]]
) -> list[Array]:
    """Poses (S, 3) of each log as effects of the reference report them.

    poses_of: the poses of the logs' paths at the logs' stamps, in any order of these.
    """
    reported = []
    for part in parts_of(logs):
        measured = []
        for log in part:
            of_position = of_heading = log.stamps
            for term in terms:
                assert isinstance(term.effect, ReferenceEffect)
                before = term.effect.delays(log.stamps, term.values)
                of_position, of_heading = of_position - before[0], of_heading - before[1]
            when = np.concatenate([of_position, of_heading])
            measured.append(replace(log.continued(when.max(initial=0.0)), stamps=when))
        for log, both in zip(part, poses_of(measured), strict=True):
            poses = np.column_stack([both[: len(log.stamps), :2], both[len(log.stamps) :, 2]])
            for term in terms:
                assert isinstance(term.effect, ReferenceEffect)
                poses = term.effect.reported(poses, log.start, term.values)
            reported.append(poses)
    return reported
