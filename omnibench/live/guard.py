"""The guard: whether a robot still moves as its calibration says and, where it does not, what has changed.

Between two reference poses the calibration predicts a motion. An extended Kalman filter follows the pose of the tracked
point (x, y, heading), the delay of the reference's stamps and the offset of its heading; with innovations v of
covariance S, and C the derivative of a measurement by the state. Let q hold whatever may have changed: the elements of
the matrix, and the delay. A change by q moves the mean of v by H q,

    B <- F B + G,    H = C B + m,    B <- B - K H,                                                              (G1)

with F the filter's transition, K its gain, G the derivative of the predicted motion and m that of the measurement. The
sums over stretches of about one metre, the blocks,

    A = sum H' S^-1 H,    b = sum H' S^-1 v,                                                                     (G2)

hold all that the innovations tell of q. What the calibration does not know of its matrix, covariance P, is no change:

    (A~, b~) = (I + A P)^-1 (A, b),    T = (d' b~)^2 / (d' A~ d)                                                 (G3)

is twice the generalised likelihood ratio of the hypothesis that q changed along d, such as by the radius of one wheel,
since the first of the blocks (Willsky and Jones, IEEE T-AC 21:108, 1976). Blocks before it tell of what the calibration
does not know. A robot that scatters more than its calibration states does so from block to block, too: Birge's ratio l
(Phys. Rev. 40:207, 1932) of the blocks' estimates of d' q, before and after the change, widens S. With n degrees of
freedom, n0 of which stand for the calibration's word,

    h = (n + 1)/2 log(1 + T / (l n))                                                                             (G4)

takes the place of T/2, and where the tail of Student's t is heavier, minus its logarithm. A change is told when h
exceeds log(looks / alpha): false alarms have the probability alpha or so over all looks. Hypotheses whose h is within
log(100) of the best are alternatives to it.

One block's estimate is wrong where the robot was pushed, a wheel slipped on an edge, or the reference jumped: a step of
the pose at one stretch that explains the last innovations better than any change. It is told as such, the filter goes
on from there, and nothing of it enters a block.

A proposal is the changed parameter with its new value. Blocks that come later decide between it and the old one by the
likelihood ratio against the calibration's value, an e-value (Grunwald et al., JRSS B 86:1091, 2024) as far as Birge's
ratio is right: the k-th proposal is accepted at an error of alpha / (k (k + 1)), and rolled back when the ratio speaks
against it later.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.special import stdtr

from omnibench.live.health import Alarm, HeldOut, Kind, Proposal
from omnibench.live.odometry import UNKNOWN_NOISE
from omnibench.live.stretches import LEAST_STEP, Hypotheses, Predictor, Stretch
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, CarDrive, pose_covariance, rotation

_ALPHA: Final = 0.05  # probability of any false alarm over all looks, and of any wrong proposal; chosen
_LOOKS: Final = 1e8  # blocks times hypotheses: a robot that drives for ten years; chosen
THRESHOLD: Final = math.log(_LOOKS / _ALPHA)  # of h, Eq. (G4)
_APART: Final = math.log(100.0)  # of h between a name and its alternatives; chosen
_STATED: Final = 12.0  # n0 of Eq. (G4) where the calibration does not say of how many runs it speaks; chosen
_LEAST_STATED: Final = 3.0  # n0, of few runs or of long-lasting slip; chosen
_METRES: Final = 1.0  # that the wheels roll in a block; chosen, as slip decorrelates within 2 m
_WANDERING: Final = 0.25  # share of what the calibration does not know that differs from path to path; chosen
_ALIKE: Final = 6  # blocks of a length, beyond which the two oldest become one of twice the length; chosen
_RECENT: Final = 8  # stretches at which a step is looked for, and which are not yet in a block; chosen
_DELAY: Final = 0.1  # s, standard deviation of the delay of a reference's stamps when a run begins; chosen
_LASTING: Final = 0.8  # share of that after another stretch; chosen
_FASTER: Final = 0.02  # m/s, a change of velocity that a delay shows at; chosen
_ASIDE: Final = 0.3  # share of a step that is not along the velocity before; chosen
_LATEST: Final = 2.0  # s: no reference is later; chosen
_RUNS: Final = 2.0  # runs for which that counts; chosen
_OFFSET: Final = 0.003  # rad, least standard deviation of a reference's heading offset in a run; chosen
_STRONG: Final = 0.04  # share of a radius: no tyre changes by more, but a wheel slips or its encoder errs; chosen
LEAST_POSES: Final = 0.2  # s between two poses that are compared; chosen
_CLIP: Final = 4.0  # of the norm of an innovation by its deviation: more counts as so much (Huber); chosen
_SQUARES: Final = 32  # innovations of which the median is taken; chosen
_DRIFTING: Final = 4.0  # times its variance, by which a reference may drift within 2 s; chosen
_REMEMBERED: Final = 256  # innovations whose tail is compared with that of normal ones; chosen
_RARE: Final = 9.837  # 0.98 quantile of chi-square with 3 degrees of freedom
_MEDIAN: Final = 2.366  # of chi-square with 3 degrees of freedom
_LEAST_PLACE: Final = 1e-4  # m, standard deviation of a reference's position; chosen
_LEAST_HEADING: Final = 1e-4  # rad, of its heading; chosen
_WRONG_SPEED: Final = 1.0  # m/s, least speed that tells a jump of the reference from a push; chosen
_SURE: Final = 3.0  # times the threshold: so large a step is no change, however well that explains it; chosen
_PARTLY: Final = 0.6  # share of what a step explains: a change that explains as much may be it; chosen
_MOSTLY: Final = 0.8  # share of a step that the motion of one wheel explains; chosen
_CAREFUL: Final = 3.0  # times the threshold of a step while a change is settled; chosen
_PERSISTENT: Final = 5  # steps of one wheel that are no burst any more; chosen
_ALIKE_EFFECT: Final = 0.01  # share of what a change does: less tells it from no other; chosen
_TURNS: Final = 1e-6  # rad/s: less is rounding
_SAME_BURST: Final = 6.0  # s within which bursts are one; chosen
_FIRST_TOLD: Final = ("trajectory", "t", "since", "since_t", "detected_after_m")  # fields that an alarm keeps
_PASSING: Final = ("push", "slip", "reference_jump", "encoder_")
_LONGEST_HISTORY: Final = 5000  # blocks; chosen
_SETTLED: Final = 10.0  # m after which an alarm of what is no parameter of the robot is taken as the new usual; chosen
_LONGEST_MEMORY: Final = 60.0  # degrees of freedom of Birge's ratio that outlive a change; chosen
_CLEAR: Final = 3.0  # standard deviations of a pose that a step has at least; chosen
_LEAST_RATIO: Final = 0.3  # of Birge: calibrations may state too much noise, too; chosen
_SCALES: Final = (1, 4, 16, 64)  # blocks that Birge's ratio joins, as slip may last; chosen


@dataclass(frozen=True)
class Moment:
    """A time, s, of a run, and the metres rolled until then, of all runs."""

    trajectory: str
    t: float
    metres: float


@dataclass(eq=False)
class _Sums:
    """Eq. (G2): A (q, q), b (q,); along the hypotheses a, b (P,), their b^2 / a, of ``count`` blocks; since when."""

    whole: Array
    score: Array
    a: Array
    b: Array
    scatter: Array
    rolled: float
    since: Moment
    count: int = 1

    def add(self, other: _Sums) -> None:
        self.whole, self.score = self.whole + other.whole, self.score + other.score
        self.a, self.b = self.a + other.a, self.b + other.b
        self.rolled += other.rolled


@dataclass(frozen=True, eq=False)
class _Recent:
    """A stretch that is not in a block yet: its sums, a and b (P,) unclipped, s, wheels whose encoders stood still."""

    sums: _Sums
    a: Array
    b: Array
    seconds: float
    still: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Verdict:
    """The hypotheses at the best onset: h, changes, their deviations, Birge's ratios (P,), and the first block."""

    h: Array
    change: Array
    deviation: Array
    ratio: Array
    first: int

    @property
    def best(self) -> int:
        return int(self.h.argmax())


class Guard:
    """Watches one robot against its calibration. ``begin`` each run, then ``take`` each stretch and the pose after it.

    alarms, proposals: all so far; the last of each may still change. history: the way, m, and h of each hypothesis (P,)
    after the latest blocks. metres, seconds: watched so far.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.hypotheses = Hypotheses.of(calibration)
        self.predictor = Predictor(calibration)
        noise = calibration.noise or UNKNOWN_NOISE
        place = max(noise.pose_position, _LEAST_PLACE)
        self._usual = pose_covariance(place, math.degrees(max(noise.pose_heading, _LEAST_HEADING)))
        self._least = np.diag([_LEAST_PLACE, _LEAST_PLACE, _LEAST_HEADING]) ** 2
        self._offset = max(noise.bias_heading, _OFFSET)
        self.alarms: list[Alarm] = []
        self.proposals: list[Proposal] = []
        self.history: deque[tuple[float, Array]] = deque(maxlen=_LONGEST_HISTORY)
        self.metres = self.seconds = 0.0
        count = len(self.hypotheses.untold)
        self._untold = self.hypotheses.untold.copy()
        self._assumed, self._driven_with, self._delay = np.zeros(count), np.zeros(count), 0.0
        self._delays: deque[float] = deque(maxlen=_LONGEST_HISTORY)  # of the runs so far
        self._delay_variance = _DELAY**2
        self._adopted: dict[int, float] = {}  # hypothesis -> change
        self._blocks: list[_Sums] = []
        self._block: _Sums | None = None
        self._recent: deque[_Recent] = deque()
        self._squares: list[float] = []
        self._slow_squares: deque[float] = deque(maxlen=_SQUARES)
        self._stretches, self._slow = 0, 1.0
        self._sum: Array = np.zeros(3)
        self._scale, self._tail, self._fastest = 1.0, 4.0, 0.0  # until it is known
        self._usual_ratio: Array = np.ones(len(self.hypotheses.names))
        told = _STATED if calibration.slip is None else min(max(calibration.slip.runs, _LEAST_STATED), _LONGEST_MEMORY)
        self._freedom: Array = np.full(len(self.hypotheses.names), float(told))
        self._alarm: int | None = None  # hypothesis of the alarm that is open
        self._shadow: tuple[int, float, float, float] | None = None  # hypothesis, change, variance, log of e
        self._kept: dict[int, tuple[int, float, float]] = {}  # accepted: hypothesis, change, log of e
        self._ratio = 1.0
        self._last_step, self._quiet = -math.inf, 0
        self._last_changed, self._changed_at = np.zeros(3), -math.inf
        self._steps_of: dict[int, int] = {}  # wheel -> steps in a row that are its own
        self._begun = False
        self._steps: Array = np.zeros((0, 5, 3))
        self._step_a: Array = np.zeros((0, 3, 3))
        self._step_b: Array = np.zeros((0, 3))
        self._step_clipped: Array = np.zeros((0, 3))
        self._open_at, self._told_at = 0, 0.0  # place of the open alarm, and the way when it was told, m
        self._shadow_from, self._shadow_errors = 0.0, (0.0, 0.0)
        self._state: Array = np.zeros(5)
        self._covariance: Array = np.zeros((5, 5))
        self._white: Array = np.zeros(3)
        self._velocity: Array = np.zeros(3)
        self._steady: tuple[Array, Array] = np.zeros(2), np.zeros((2, 2))

    def begin(self, pose: Array, covariance: Array | None = None) -> None:
        """Begin a run at a reference pose (3,), m, m, rad, with its covariance (3, 3); None: the calibration's."""
        self.end()
        self._quiet = 0
        if self._begun:  # delays that differ from run to run are no change of the reference
            self._delays.append(float(self._state[3]))
            self._spread_of_delays()
        self._state = np.array([*pose.tolist(), self._delay, 0.0])
        self._covariance = np.zeros((5, 5))
        self._covariance[:3, :3] = self._usual if covariance is None else covariance + self._least
        self._covariance[3, 3] = self._delay_variance
        variance = self._offset**2
        self._covariance[2, 2] += variance
        self._covariance[2, 4] = self._covariance[4, 2] = -variance
        self._covariance[4, 4] = variance
        self._deviation = np.zeros((5, len(self._assumed)))  # B of Eq. (G1)
        self._forget_steps()
        self._faster, self._white = np.zeros((3, 3)), np.zeros(3)
        self._steady = self._state[3:].copy(), self._covariance[3:, 3:].copy()
        self._begun = False

    def take(
        self, stretch: Stretch, pose: Array, at: tuple[str, float], covariance: Array | None = None
    ) -> list[Alarm]:
        """Compare a stretch with the reference pose (3,) at its end; the alarms that are new or have changed.

        at: name of the run and time in it, s. covariance: as of ``begin``.
        """
        self.metres, self.seconds = self.metres + stretch.way, self.seconds + stretch.seconds
        speed = stretch.way / max(stretch.seconds, 1e-9)
        self._fastest = max(self._fastest, speed)
        # Predict, Eq. (G1).
        state, heading = self._state, float(self._state[2])
        turn = rotation(heading)
        slopes = turn @ stretch.slopes
        if not self._begun:  # what the reference tells of a robot that moves already is late
            self._be_late(turn @ stretch.begun)
            self._begun = True
        moved = turn @ stretch.moved + slopes @ (self._assumed - self._driven_with)
        state[:3] += moved
        transition = np.eye(5)
        transition[0, 2], transition[1, 2] = -moved[1], moved[0]
        self._covariance = transition @ self._covariance @ transition.T
        self._covariance[:3, :3] += turn @ stretch.spread @ turn.T
        self._deviation = transition @ self._deviation
        self._deviation[:3] += slopes
        arrived = np.zeros((1, 5, 3))
        arrived[0, :3] = np.eye(3)
        self._steps = np.concatenate([transition @ self._steps, arrived])[-_RECENT:]
        self._step_a = np.concatenate([self._step_a, np.zeros((1, 3, 3))])[-_RECENT:]
        self._step_b = np.concatenate([self._step_b, np.zeros((1, 3))])[-_RECENT:]
        self._step_clipped = np.concatenate([self._step_clipped, np.zeros((1, 3))])[-_RECENT:]
        # Measure.
        self._velocity = velocity = turn @ stretch.velocity
        measured = np.zeros((3, 5))
        measured[:, :3], measured[:, 3], measured[2, 4] = np.eye(3), -velocity, 1.0
        innovation = pose - measured @ state
        innovation[2] -= math.tau * round(float(innovation[2]) / math.tau)
        noise = self._usual if covariance is None else covariance + self._least
        faster = turn @ (stretch.velocity - stretch.begun)  # a delay shows while the velocity changes, in part
        spread = measured @ self._covariance @ measured.T + self._scale * noise
        self._moving = speed > _FASTER
        self._faster = _LASTING * self._faster + faster[:, None] * faster
        if np.hypot(faster[0], faster[1]) > _FASTER and self._fastest > 0:
            self._last_changed, self._changed_at = faster, self.seconds
        spread += self._delay_variance * self._faster
        information = np.linalg.inv(spread)
        square = float(innovation @ information @ innovation)
        # By differences from one to the next, in which what changed cancels out.
        white = np.linalg.solve(np.linalg.cholesky(spread), innovation)
        self._squares.append(float(np.square(white - self._white).sum()) / 2)
        self._white, self._sum = white, self._sum + white
        self._stretches += 1
        if self._stretches % _RECENT == 0:  # sums of several are larger where the reference drifts
            self._slow_squares.append(float(np.square(self._sum).sum()) / _RECENT)
            self._slow = max(1.0, float(np.median(self._slow_squares)) / _MEDIAN)
            self._sum = np.zeros(3)
        if len(self._squares) % _SQUARES == 0:  # a reference that scatters more than it says counts for less
            self._scale = max(1.0, self._scale * float(np.median(self._squares[-_SQUARES:])) / _MEDIAN)
            self._squares = self._squares[-_REMEMBERED:]
            self._tail = max(1.0, float(np.quantile(self._squares, 0.98)) / _RARE)
        weight = min(1.0, _CLIP / math.sqrt(max(square, 1e-12)))
        gain = weight * self._covariance @ measured.T @ information
        slope = measured @ self._deviation
        slope[:, -1] -= velocity
        told = slope.T @ information
        along = slope @ self.hypotheses.directions
        told_along = along.T @ information
        whole = told @ slope
        now = Moment(*at, self.metres)
        a = np.einsum("ij,ji->i", told_along, along)
        sums = _Sums(  # what is clipped tells less
            weight * whole,
            weight * (told @ innovation),
            weight * a,
            weight * (told_along @ innovation),
            np.zeros(len(self.hypotheses.names)),
            stretch.rolled,
            now,
        )
        self._recent.append(_Recent(sums, a, told_along @ innovation, stretch.seconds, stretch.still))
        if self._quiet and len(self._recent) > _RECENT:
            self._recent.popleft()
        of_steps = measured @ self._steps
        self._step_a += np.swapaxes(of_steps, 1, 2) @ information @ of_steps
        along_steps = np.swapaxes(of_steps, 1, 2) @ (information @ innovation)
        self._step_b += along_steps
        self._step_clipped += weight * along_steps
        state += gain @ innovation
        self._covariance -= gain @ measured @ self._covariance
        self._deviation -= gain @ slope
        self._steps = self._steps - gain @ of_steps
        step = self._find_step(now, pose, self._scale * noise)
        if step is not None:
            return step
        if self._quiet:
            self._quiet = _RECENT if stretch.still else self._quiet - 1
            if not self._quiet:
                self._anchor(pose, self._scale * noise)
                self._recent.clear()
                self._steps_of.clear()
            return []
        # What is older than any step enters the block.
        if len(self._recent) > _RECENT:
            return self._enter()
        return []

    def _find_step(self, now: Moment, pose: Array, noise: Array) -> list[Alarm] | None:
        """Tell a step of the pose at one of the last stretches, where it explains them better than any change.

        The filter begins again at the pose, and nothing enters a block until it is sure that the step is over.
        """
        tail = max(self._tail, self._slow, self._ratio) * (1.0 if self._alarm is None else _CAREFUL)
        regular = self._step_a + 1e-9 * np.eye(3)
        both = np.stack([self._step_b, self._step_clipped], axis=2)
        steps, clipped = np.moveaxis(np.linalg.solve(regular, both), 2, 0)
        # One pose that is far off is no step: each counts as much as a clipped one at most.
        gains = np.einsum("ij,ij->i", self._step_clipped, clipped) / (2 * tail)
        at = int(gains.argmax())
        gain, step, reach = float(gains[at]), steps[at], max(self.predictor.reach, 0.1)
        size, turned = math.hypot(step[0], step[1]), abs(float(step[2]))
        least = max(LEAST_STEP, _CLEAR * math.sqrt((noise[0, 0] + noise[1, 1]) / 2))
        if gain <= THRESHOLD or max(size, turned * reach) < least:
            return None
        if self._is_late(step):
            self._anchor(pose, noise)
            self._recent.clear()
            return []
        parts = list(self._recent)[at - len(self._steps) :]
        whole = float(self._step_b[at] @ step) / 2
        name, kind = self._name_step(parts, regular[at], self._step_b[at], whole, size)
        # Changes since any of these stretches; a silent encoder is none, however well they explain it.
        b, a = (np.cumsum([getattr(part, name) for part in reversed(self._recent)], axis=0) for name in "ba")
        rival = float((b * b / (2 * np.maximum(a, 1e-12))).max())
        rivals = rival > whole - _APART * tail or (whole < _SURE * THRESHOLD * tail and rival > _PARTLY * whole)
        if rivals and not name.startswith("encoder_"):
            return None
        since = parts[0].sums.since
        self._anchor(pose, noise)
        self._recent.clear()
        self._quiet = _RECENT
        value, unit = (size, "m") if size > turned * reach else (turned, "rad")
        before = self.alarms[-1] if self.alarms and self.seconds - self._last_step < _SAME_BURST else None
        self._last_step = self.seconds
        is_open = self._alarm is not None and self._open_at == len(self.alarms) - 1
        if before is not None and before.name.startswith(_PASSING) and not is_open:  # it goes on
            began = Moment(before.since, before.since_t, now.metres - before.detected_after_m)
            value += (before.value or 0.0) if unit == before.unit else 0.0
            if before.kind != "reference" and kind != "fault":
                name, kind = before.name, before.kind
            elif before.kind == "reference" and kind == "reference":
                name, kind = "push", "burst"
            since = began
            self.alarms.pop()
        alarm = Alarm(
            kind=kind,
            name=name,
            value=float(value),
            unit=unit,
            trajectory=now.trajectory,
            t=now.t,
            since=since.trajectory,
            since_t=since.t,
            detected_after_m=max(now.metres - since.metres, 0.0),
        )
        self.alarms.append(alarm)
        return [alarm]

    def _forget_steps(self) -> None:
        self._steps, self._step_a, self._step_b, self._step_clipped = (
            each[:0] for each in (self._steps, self._step_a, self._step_b, self._step_clipped)
        )

    def _is_late(self, step: Array) -> bool:
        """True if a step is the rest of the way that the reference is late by, after the velocity changed."""
        changed = self._last_changed
        if self.seconds - self._changed_at > _LATEST or self._moving or not np.any(changed):
            return False
        late = float(step @ changed / (changed @ changed))
        if abs(late) > _LATEST or np.linalg.norm(step - late * changed) > _ASIDE * np.linalg.norm(step):
            return False
        self._delays.append(late)
        self._spread_of_delays()
        return True

    def _spread_of_delays(self) -> None:
        """Take delays that differ from run to run for no change of the reference."""
        spread = np.square(np.array(self._delays) - np.mean(self._delays)).sum() + _RUNS * _DELAY**2
        self._delay_variance = float(spread) / (_RUNS + len(self._delays))
        self._untold[-1, -1] = self._delay_variance

    def _name_step(self, parts: Sequence[_Recent], a: Array, b: Array, gain: float, size: float) -> tuple[str, Kind]:
        """The name of a step in these stretches, of this size, m, that explains this much of them."""
        matrix, turn = self.calibration.matrix_array, rotation(float(self._state[2]))
        edges = [*self.predictor.columns.tolist(), matrix.shape[1]]
        explained = []
        for low, high in pairwise(edges):
            along = turn @ matrix[:, low:high]
            score = along.T @ b
            explained.append(float(score @ np.linalg.lstsq(along.T @ a @ along, score)[0]) / 2)
        still = {wheel for part in parts for wheel in part.still}
        silent = max(still, key=lambda wheel: explained[wheel], default=None)
        if silent is not None and explained[silent] > _MOSTLY * gain:
            return f"encoder_{self.calibration.robot.wheel_names[silent]}", "fault"
        wheel = int(np.argmax(explained))
        if explained[wheel] > _MOSTLY * gain and len(explained) == len(self.calibration.robot.wheel_names):
            self._steps_of[wheel] = self._steps_of.get(wheel, 0) + 1
            if self._steps_of[wheel] > _PERSISTENT:
                return f"slip_{self.calibration.robot.wheel_names[wheel]}", "fault"
        else:
            self._steps_of.clear()
        seconds = float(np.mean([part.seconds for part in parts]))
        if size / max(seconds, 1e-9) > max(_WRONG_SPEED, 1.5 * self._fastest):
            return "reference_jump", "reference"
        return "push" if sum(part.sums.rolled for part in parts) < size / 2 else "slip", "burst"

    def _anchor(self, pose: Array, noise: Array) -> None:
        """Begin the filter again at a measured pose, with the delay and the offset as they were before the step."""
        self._state[3:], self._covariance[3:, 3:] = self._steady
        self._state[:3] = pose
        self._state[2] -= self._state[4]
        self._covariance[:3, 3:] = self._covariance[3:, :3] = 0.0
        self._covariance[:3, :3] = noise
        self._covariance[2, 2] += (variance := float(self._covariance[4, 4]))
        self._covariance[2, 4] = self._covariance[4, 2] = -variance
        self._deviation[:] = 0.0
        self._be_late(self._velocity)
        self._forget_steps()

    def _be_late(self, velocity: Array) -> None:
        """Correct a pose that was taken as it was measured for the delay, at a velocity (3,) in the map."""
        delayed = np.array([*velocity.tolist(), 1.0, 0.0])
        variance, self._covariance[3, 3] = float(self._covariance[3, 3]), 0.0
        self._covariance += variance * delayed[:, None] * delayed
        self._state[:3] += velocity * self._state[3]

    def _enter(self) -> list[Alarm]:
        """Add the oldest stretch to the block, which is judged when it is long enough."""
        sums = self._recent.popleft().sums
        if self._block is None:
            self._block = sums
        else:
            self._block.add(sums)
        if self._block.rolled < _METRES:
            return []
        return self._judge()

    def end(self) -> None:
        """Judge what waits, at the end of a run."""
        while self._recent and not self._quiet:
            self._enter()
        self._recent.clear()

    @property
    def accepted(self) -> dict[str, float]:
        """The changes that were accepted and not rolled back, by the names of their parameters, in their units."""
        names = {each.name for each in self.proposals if each.accepted and not each.rolled_back}
        return {n: self._adopted[k] for k, n in enumerate(self.hypotheses.names) if n in names and k in self._adopted}

    def proposed(self, changes: Mapping[str, float] | None = None) -> Calibration | None:
        """The calibration with changes of parameters, by default those that were accepted; None if there are none."""
        changes = self.accepted if changes is None else changes
        if not changes:
            return None
        calibration, names = self.calibration, self.hypotheses.names
        moved = np.zeros(calibration.matrix_array.size)
        for name, value in changes.items():
            moved += value * self.hypotheses.directions[: len(moved), names.index(name)]
        changed: dict[str, object] = {
            "matrix": _rows(calibration.matrix_array, moved),
            "name": f"{calibration.name}+{'+'.join(changes)}",
        }
        if calibration.plain is not None:
            changed["plain"] = _rows(np.array(calibration.plain), moved)
        if calibration.parameters is not None:
            known = dict(calibration.parameters)
            for name, value in changes.items():
                if (parameter := known.get(name)) is not None:
                    update = {"value": parameter.value + value, "low": None, "high": None}
                    known[name] = parameter.model_copy(update=update)
            changed["parameters"] = known
        return calibration.model_copy(update=changed)

    @property
    def settled(self) -> bool:
        """True if no alarm is open."""
        return self._alarm is None

    def drives_with(self, changes: Mapping[str, float]) -> None:
        """Take it that the robot drives with changes of parameters from now on, which stretches then hold."""
        names = self.hypotheses.names
        self._driven_with = np.zeros(len(self._assumed))
        for name, value in changes.items():
            self._driven_with += value * self.hypotheses.directions[:, names.index(name)]

    def _judge(self) -> list[Alarm]:
        """Close the block; judge all of them, the alarm that is open, and what is in shadow."""
        block, self._block = self._block, None
        self._steady = self._state[3:].copy(), self._covariance[3:, 3:].copy()
        assert block is not None
        block.scatter = block.b**2 / np.maximum(block.a, 1e-12)
        self._blocks.append(block)
        # Older blocks are joined by twos, so that windows of all lengths remain.
        size = 1
        while sum(each.count == size for each in self._blocks) > _ALIKE:
            first = next(k for k, each in enumerate(self._blocks) if each.count == size)
            older, newer = self._blocks[first : first + 2]
            older.add(newer)
            older.scatter, older.count = older.scatter + newer.scatter, 2 * size
            del self._blocks[first + 1]
            size *= 2
        verdict = self._verdict()
        self.history.append((self.metres, verdict.h))
        self._ratio = float(np.median(verdict.ratio))
        self._weigh(block, verdict)
        if not self._blocks or (self._alarm is None and verdict.h[verdict.best] <= THRESHOLD):
            return []
        return self._tell(verdict)

    def _verdict(self) -> _Verdict:
        """Eq. (G3) and (G4) for changes since several of the blocks."""
        count = len(self._blocks)
        a, b, scatter = (np.array([getattr(block, name) for block in self._blocks]) for name in ("a", "b", "scatter"))
        numbers = np.array([block.count for block in self._blocks])
        ratios = np.full((count, a.shape[1]), _LEAST_RATIO)
        freedom = self._freedom + max(int(numbers.sum()) - 2, 0)
        for scale in _SCALES:
            places = (np.cumsum(numbers) - numbers) // scale
            edges = np.flatnonzero(np.diff(places, prepend=-1))
            ga, gb, sizes = (np.add.reduceat(rows, edges, axis=0) for rows in (a, b, numbers))
            within = scatter if scale == 1 else gb**2 / np.maximum(ga, 1e-12)
            groups = sizes if scale == 1 else np.ones(len(edges))
            before = _scatter_within(ga, gb, within, groups)
            after = [row[::-1] for row in _scatter_within(ga[::-1], gb[::-1], within[::-1], groups[::-1])]
            stated = np.maximum(self._freedom / scale, _LEAST_STATED)
            for first in range(count):
                right = int(np.searchsorted(edges, first))  # groups wholly after, and wholly before
                left = right if right < len(edges) and edges[right] == first else max(right - 1, 0)
                squares, free = before[0][left] + after[0][right], before[1][left] + after[1][right]
                ratio = (stated * self._usual_ratio + squares) / (stated + free)
                ratios[first] = np.maximum(ratios[first], ratio)
        # A reference that drifts errs at the ends of a window, however long that is; what is more is a change.
        ratios *= 1 + (min(self._slow, _DRIFTING) - 1) / numbers[::-1].cumsum()[::-1, None]
        # What the blocks before tell of what the calibration does not know, and what is left of it.
        wholes = np.cumsum([0 * self._untold, *(block.whole for block in self._blocks)], axis=0)
        scores = np.cumsum([0 * self._untold[0], *(block.score for block in self._blocks)], axis=0)
        common = np.median(ratios, axis=1)
        identity, untold = np.eye(len(self._untold)), self._untold
        before = wholes[:-1] / common[:, None, None]
        known = np.linalg.solve(identity + untold @ before, np.broadcast_to(untold, before.shape))
        whole = (wholes[-1] - wholes[:-1]) / common[:, None, None]
        score = (scores[-1] - scores[:-1]) / common[:, None]
        mean = (known @ (scores[:-1] / common[:, None])[:, :, None])[:, :, 0]
        score -= (whole @ mean[:, :, None])[:, :, 0]
        known = known + _WANDERING * (untold - known)
        joint = np.linalg.solve(identity + whole @ known, np.concatenate([whole, score[:, :, None]], axis=2))
        directions = self.hypotheses.directions
        along = np.einsum("qp,fqr,rp->fp", directions, joint[:, :, :-1], directions)
        slope = joint[:, :, -1] @ directions
        along = np.maximum(along, 1e-12)
        shrunk = np.minimum(common[:, None] / ratios, 1.0)
        h = (freedom + 1) / 2 * np.log1p(shrunk * slope**2 / along / freedom)
        # With few degrees of freedom the tail of Student's t is heavier than that.
        tail = 2 * stdtr(np.broadcast_to(freedom, h.shape), -np.sqrt(shrunk * slope**2 / along))
        h = np.minimum(h, -np.log(np.maximum(tail, np.finfo(float).tiny)))
        h[np.abs(slope / along) > self.hypotheses.largest] = 0.0
        row = int(h.max(axis=1).argmax())
        deviation = np.sqrt(1 / along[row] / shrunk[row])
        return _Verdict(h[row], slope[row] / along[row], deviation, ratios[row], row)

    def _tell(self, verdict: _Verdict) -> list[Alarm]:
        """Tell a change, or more of the one that is open; propose its value, and go on from it when it is settled."""
        best, hypotheses = verdict.best, self.hypotheses
        since, told = self._blocks[verdict.first].since, self._alarm is not None
        if verdict.h[best] > THRESHOLD or not told:
            alarm = self._alarm_of(verdict, since)
            if told:
                self._retell(alarm)
            else:
                self._open_at, self._told_at = len(self.alarms), self.metres
                self.alarms.append(alarm)
            self._alarm = best
        alarm = self.alarms[self._open_at]
        assert self._alarm is not None
        named, change = self._alarm, float(verdict.change[self._alarm])
        variance = float(verdict.deviation[named]) ** 2
        proposable = alarm.kind == "change" and hypotheses.names[named] != "floor" and not alarm.alternatives
        if proposable and self._shadow is None:
            value = float(hypotheses.values[named] + self._adopted.get(named, 0.0) + change)
            self.proposals.append(Proposal(name=hypotheses.names[named], value=value, since=alarm.since))
            self._shadow = (named, change, variance, 0.0)
            self._shadow_from, self._shadow_errors = self.metres, (0.0, 0.0)
        elif not proposable and not alarm.alternatives and self.metres - self._told_at > _SETTLED:
            self._adopt(named, change, variance)
        return [alarm]

    def _retell(self, alarm: Alarm) -> None:
        """Say of the open alarm what is known by now; when it was told first stays."""
        first = self.alarms[self._open_at]
        self.alarms[self._open_at] = alarm.model_copy(update={name: getattr(first, name) for name in _FIRST_TOLD})

    def _alarm_of(self, verdict: _Verdict, since: Moment) -> Alarm:
        best, hypotheses, now = verdict.best, self.hypotheses, self._blocks[-1].since
        name, kind = hypotheses.names[best], hypotheses.kinds[best]
        value = float(hypotheses.values[best] + self._adopted.get(best, 0.0) + verdict.change[best])
        reach = 1.96 * float(verdict.deviation[best])
        if kind == "change" and name.startswith("radius_"):
            share = float(verdict.change[best]) / hypotheses.values[best]
            if abs(share) > _STRONG:  # a tyre does not change so much
                kind, name = "fault", ("encoder_" if share > 0 else "slip_") + name.removeprefix("radius_")
        near = np.argsort(-verdict.h)
        others = [int(j) for j in near if j != best and verdict.h[j] > verdict.h[best] - _APART]
        return Alarm(
            kind=kind,
            name=name,
            value=value,
            low=value - reach,
            high=value + reach,
            unit=hypotheses.units[best],
            trajectory=now.trajectory,
            t=now.t,
            since=since.trajectory,
            since_t=since.t,
            detected_after_m=max(self.metres - since.metres, 0.0),
            alternatives=tuple(hypotheses.names[j] for j in others),
            advice=self._advice(best, others, verdict) if others else "",
        )

    def _advice(self, best: int, others: Sequence[int], verdict: _Verdict) -> str:
        """The motion in which the hypotheses differ most, as an imperative."""
        size = self.calibration.matrix_array.size
        motions = self.calibration.robot.motions
        signals = np.linalg.pinv(self.calibration.robot.centre_matrix) @ motions.T
        reach, sizes = max(self.predictor.reach, 0.1), np.maximum(np.linalg.norm(motions[:, :2], axis=1), 0.1)

        def effect(hypothesis: int) -> Array:
            """What a change does to each motion (3, D), m."""
            change = self.hypotheses.directions[:size, hypothesis] * verdict.change[hypothesis]
            moved: Array = change.reshape(3, -1) @ signals
            moved[2] *= reach
            return moved / sizes

        own = effect(best)
        apart = np.min([np.linalg.norm(own - effect(other), axis=0) for other in others], axis=0)
        if not apart.max() > _ALIKE_EFFECT * np.linalg.norm(own):
            return "no motion tells them apart"
        motion = motions[int(apart.argmax())]
        if abs(motion[2]) > _TURNS:
            return "drive a curve" if isinstance(self.calibration.robot.drive, CarDrive) else "turn on the spot"
        return "drive sideways" if abs(motion[1]) > abs(motion[0]) else "drive straight"

    def _weigh(self, block: _Sums, verdict: _Verdict) -> None:
        """Judge what is in shadow, and what was accepted, by a new block."""
        level = math.log(len(self.proposals) * (len(self.proposals) + 1) / _ALPHA) if self.proposals else 0.0
        if self._shadow is not None:
            named, change, variance, evidence = self._shadow
            ratio = float(verdict.ratio[named])
            gain = change * float(block.b[named]) - change**2 * float(block.a[named]) / 2
            evidence += gain / ratio
            before, after = self._shadow_errors
            before += float(block.scatter[named])
            after += float((block.b[named] - change * block.a[named]) ** 2 / max(block.a[named], 1e-12))
            self._shadow_errors = before, after
            self._shadow = (named, change, variance, evidence)
            other = verdict.best
            ousted = other != named and verdict.h[other] > verdict.h[named] + _APART
            sure = other == named and float(np.partition(verdict.h, -2)[-2]) < verdict.h[named] - _APART
            if (evidence > level and sure) or evidence < -level or ousted:
                accepted = evidence > level and not ousted
                reason = "predicts later motion better" if accepted else "predicts later motion worse"
                if ousted and not accepted:
                    reason = f"{self.hypotheses.names[other]} explains it better"
                self._note(accepted=accepted, reason=reason)
                if accepted:
                    refined, deviation = float(verdict.change[named]), float(verdict.deviation[named])
                    value = float(self.hypotheses.values[named] + self._adopted.get(named, 0.0) + refined)
                    interval = {"low": value - 1.96 * deviation, "high": value + 1.96 * deviation}
                    self.proposals[-1] = self.proposals[-1].model_copy(update={"value": value, **interval})
                    self._retell(self._alarm_of(verdict, self._blocks[verdict.first].since))
                    self._adopt(named, refined, deviation**2)
                    self._kept[len(self.proposals) - 1] = named, refined, 0.0
                    return
                self._shadow = None
            else:
                self._note(accepted=None, reason="")
        for number, (named, change, evidence) in list(self._kept.items()):
            loss = change * float(block.b[named]) + change**2 * float(block.a[named]) / 2
            evidence -= loss / float(verdict.ratio[named])
            self._kept[number] = named, change, evidence
            if evidence > level:
                update = {"rolled_back": True, "reason": "predicts later motion worse after all"}
                self.proposals[number] = self.proposals[number].model_copy(update=update)
                self._adopt(named, -change, 0.0)
                del self._kept[number]
                return

    def _note(self, *, accepted: bool | None, reason: str) -> None:
        """Write down how the proposal in shadow does."""
        assert self._shadow is not None
        before, after = self._shadow_errors
        held_out = HeldOut(
            metres=self.metres - self._shadow_from,
            log_e=self._shadow[3],
            error_ratio=math.sqrt(after / before) if before > 0 else None,
        )
        self.proposals[-1] = self.proposals[-1].model_copy(
            update={"accepted": accepted, "reason": reason, "held_out": held_out}
        )

    def _adopt(self, named: int, change: float, variance: float) -> None:
        """Go on from a change: what comes is compared with it, as sure as its value is."""
        direction = self.hypotheses.directions[:, named]
        self._assumed = self._assumed + change * direction
        self._adopted[named] = self._adopted.get(named, 0.0) + change
        self._state = self._state + self._deviation @ (change * direction)
        if self.hypotheses.names[named] == "reference_clock":
            self._delay += change
            self._state[3] += change
        self._untold = self._untold + variance * direction[:, None] * direction
        verdict = self._verdict()
        self._usual_ratio = verdict.ratio
        self._freedom = np.minimum(self._freedom + sum(block.count for block in self._blocks), _LONGEST_MEMORY)
        self._blocks.clear()
        self._recent.clear()
        self._forget_steps()
        self._alarm, self._shadow = None, None


def _rows(matrix: Array, change: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, (matrix + change.reshape(matrix.shape)).tolist()))


def _scatter_within(a: Array, b: Array, within: Array, groups: Array) -> tuple[Array, Array]:
    """Scatter (G + 1, P) of the first blocks' estimates about their mean, and its degrees of freedom (G + 1,)."""
    none = np.zeros((1, a.shape[1]))
    sums = [np.concatenate([none, np.cumsum(rows, axis=0)]) for rows in (a, b, within)]
    squares = np.maximum(sums[2] - sums[1] ** 2 / np.maximum(sums[0], 1e-12), 0.0)
    return squares, np.maximum(np.concatenate([[0.0], np.cumsum(groups)]) - 1, 0.0)
