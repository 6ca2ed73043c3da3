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
from omnibench.live.innovations import RECENT, Innovation, PoseFilter, Step
from omnibench.live.stretches import Hypotheses, Predictor, Stretch
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, CarDrive, rotation

# All are chosen here and below.
_ALPHA: Final = 0.05  # probability of any false alarm over all looks, and of any wrong proposal
_LOOKS: Final = 1e8  # number of looks, blocks times hypotheses: a robot that drives for ten years
THRESHOLD: Final = math.log(_LOOKS / _ALPHA)  # h, Eq. (G4), beyond which a change is told
_APART: Final = math.log(100.0)  # hypotheses whose h is nearer to the best one's are alternatives to it
LEAST_POSES: Final = 0.2  # time between two poses that are compared at least, s
_LEAST: Final = 1e-12  # least information that a quotient is taken of


@dataclass(frozen=True)
class Moment:
    """A time, s, of a run, and the metres rolled until then, of all runs."""

    trajectory: str
    t: float
    metres: float


@dataclass(frozen=True, eq=False)
class _Recent:
    """A stretch that is in no block yet, the innovation of the pose at its end, and when that was."""

    stretch: Stretch
    innovation: Innovation
    end: Moment


@dataclass(eq=False)
class _Block:
    """Eq. (G2) over a metre, or over ``count`` such blocks in a row that are joined: A (q, q), b (q,).

    since: the end of its first stretch. rolled: m. scatter (P,): sum over the blocks of (d' b)^2 / (d' A d).
    """

    whole: Array
    score: Array
    since: Moment
    rolled: float
    scatter: Array
    count: int = 1

    def join(self, other: _Block) -> None:
        """Add the block that follows."""
        self.whole, self.score = self.whole + other.whole, self.score + other.score
        self.rolled, self.scatter = self.rolled + other.rolled, self.scatter + other.scatter
        self.count += other.count


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


@dataclass(eq=False)
class _Trial:
    """How a change of one hypothesis does on the blocks that come after it was proposed or, later, accepted.

    number: of the proposal. begun: m driven until then. variance: of the change, once it is accepted. log_e: log of
    the likelihood ratio, for the change while it is in shadow and against it later. without, within: sums of squared
    errors without and with it.
    """

    number: int
    hypothesis: int
    change: float
    begun: float
    variance: float = 0.0
    log_e: float = 0.0
    without: float = 0.0
    within: float = 0.0


_METRES: Final = 1.0  # length of a block, m rolled: slip decorrelates within 2 m
_ALIKE: Final = 6  # number of blocks of one length, beyond which the oldest two become one
_STATED: Final = 12.0  # n0 of Eq. (G4) where the calibration does not say of how many runs it speaks
_LEAST_STATED: Final = 3.0  # least n0, for few runs and for slip that lasts
_LONGEST_MEMORY: Final = 60.0  # degrees of freedom at most by which Birge's ratio outlives a change
_LONGEST_HISTORY: Final = 5000  # number of blocks that a report shows at most
_WANDERING: Final = 0.25  # share of what the calibration does not know that differs from path to path
_DRIFTING: Final = 4.0  # largest factor on the variance of a reference that drifts
_LEAST_RATIO: Final = 0.3  # least ratio of Birge: calibrations may state too much noise, too
_SCALES: Final = (1, 4, 16, 64)  # lengths, in blocks, over which Birge's ratio is taken, as slip may last
_STRONG: Final = 0.04  # share of a radius: no tyre changes by more, but a wheel slips or its encoder errs
_ALIKE_EFFECT: Final = 0.01  # two changes are alike that differ by less than this share of what they do
_TURNING: Final = 1e-6  # least yaw rate of a motion that turns, rad/s
_SETTLED: Final = 10.0  # way, m, after which an alarm of what is no parameter of the robot is the new usual
_FIRST_TOLD: Final = ("trajectory", "t", "since", "since_t", "detected_after_m")  # fields that an alarm keeps

_SURE: Final = 3.0  # a step beyond so many thresholds is no change, however well that explains it
_PARTLY: Final = 0.6  # a change that explains this share of what a step explains may be the cause instead
_MOSTLY: Final = 0.8  # a step is one wheel's if that wheel's motion explains this share of it
_CAREFUL: Final = 3.0  # factor on the threshold of a step while an alarm is open
_PERSISTENT: Final = 5  # number of steps of one wheel in a row beyond which it is no burst any more
_WRONG_SPEED: Final = 1.0  # m/s, least speed that tells a jump of the reference from a push
_SAME_BURST: Final = 6.0  # s within which bursts are one
_PASSING: Final = ("push", "slip", "reference_jump", "encoder_")


class Guard:
    """Watches one robot against its calibration. ``begin`` each run, then ``take`` each stretch and the pose after it.

    alarms, proposals: all so far; the last of each may still change. history: the way, m, and h of each hypothesis (P,)
    after the latest blocks. metres: watched so far.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.hypotheses = Hypotheses.of(calibration)
        self.predictor = Predictor(calibration)
        self.alarms: list[Alarm] = []
        self.proposals: list[Proposal] = []
        self.history: deque[tuple[float, Array]] = deque(maxlen=_LONGEST_HISTORY)
        self.metres = 0.0
        size, count = self.hypotheses.directions.shape
        self._filter = PoseFilter(calibration, size)
        self._reach = max(self.predictor.reach, 0.1)  # m
        self._prior = self.hypotheses.prior.copy()
        self._assumed, self._driven_with = np.zeros(size), np.zeros(size)
        self._adopted: dict[int, float] = {}  # hypothesis -> change
        self._recent: deque[_Recent] = deque()
        self._block: _Block | None = None  # the one that grows
        self._blocks: list[_Block] = []
        # Birge's ratios before the oldest block, and the degrees of freedom that stand for them.
        runs = _STATED if calibration.slip is None else calibration.slip.runs
        self._usual_ratio: Array = np.ones(count)
        self._freedom = float(min(max(runs, _LEAST_STATED), _LONGEST_MEMORY))
        self._ratio = 1.0  # median over the hypotheses of Birge's ratio in the last verdict
        self._alarm: int | None = None  # hypothesis of the alarm that is open
        self._open_at, self._told_at = 0, 0.0  # its place, and the way when it was told, m
        self._shadow: _Trial | None = None
        self._accepted: list[_Trial] = []
        self._last_step, self._quiet = -math.inf, 0  # s, when a step was found last; stretches until blocks go on
        self._steps_of: dict[int, int] = {}  # wheel -> steps in a row that are its own

    @property
    def seconds(self) -> float:
        """Time watched so far, s."""
        return self._filter.seconds

    @property
    def settled(self) -> bool:
        """True if no alarm is open."""
        return self._alarm is None

    def begin(self, pose: Array, covariance: Array | None = None) -> None:
        """Begin a run at a reference pose (3,), m, m, rad, with its covariance (3, 3); None: the calibration's."""
        self.end()
        self._quiet = 0
        learnt = self._filter.begun
        self._filter.begin(pose, covariance)
        if learnt:
            self._prior[-1, -1] = self._filter.delay.variance

    def take(
        self, stretch: Stretch, pose: Array, at: tuple[str, float], covariance: Array | None = None
    ) -> list[Alarm]:
        """Compare a stretch with the reference pose (3,) at its end; the alarms that are new or have changed.

        at: name of the run and time in it, s. covariance: as of ``begin``.
        """
        self.metres += stretch.way
        innovation = self._filter.take(stretch, pose, covariance, self._assumed - self._driven_with)
        self._recent.append(_Recent(stretch, innovation, Moment(*at, self.metres)))
        if self._quiet and len(self._recent) > RECENT:
            self._recent.popleft()
        # A step is told, and nothing enters a block until it is sure that it is over.
        if (step := self._filter.step(self._tail, self._reach)) is not None and step.gain > THRESHOLD:
            if not self._filter.moving and self._filter.delay.explains(step.step, self.seconds):
                self._prior[-1, -1] = self._filter.delay.variance
                self._filter.anchor()
                self._recent.clear()
                return []
            if (alarm := self._alarm_of_step(step)) is not None:
                self._filter.anchor()
                self._recent.clear()
                self._quiet = RECENT
                self.alarms.append(alarm)
                return [alarm]
        if self._quiet:
            self._quiet = RECENT if stretch.still else self._quiet - 1
            if not self._quiet:
                self._filter.anchor()
                self._recent.clear()
                self._steps_of.clear()
            return []
        # What is older than any step enters the block.
        return self._enter() if len(self._recent) > RECENT else []

    def end(self) -> None:
        """Judge what waits, at the end of a run."""
        while self._recent and not self._quiet:
            self._enter()
        self._recent.clear()

    @property
    def _tail(self) -> float:
        """Factor on the squares of innovations, so that those of this robot are as rare as normal ones."""
        noise = self._filter.noise
        return max(noise.tail, noise.drift, self._ratio) * (1.0 if self.settled else _CAREFUL)

    def _alarm_of_step(self, step: Step) -> Alarm | None:
        """The alarm of a step; None where a change explains it as well."""
        parts, now = list(self._recent)[-step.last :], self._recent[-1].end
        size, turned = math.hypot(step.step[0], step.step[1]), abs(float(step.step[2]))
        name, kind = self._name_of_step(step, parts, size)
        # Changes since any of these stretches; a silent encoder is none, however well they explain it.
        whole, score = np.zeros_like(self._prior), np.zeros(len(self._prior))
        rival, directions = 0.0, self.hypotheses.directions
        for recent in reversed(self._recent):
            whole, score = whole + recent.innovation.whole, score + recent.innovation.score
            along = np.maximum(_along(whole, directions), _LEAST)
            rival = max(rival, float(((score @ directions) ** 2 / along).max()) / 2)
        near = rival > step.whole - _APART * self._tail
        may_be = step.whole < _SURE * THRESHOLD * self._tail and rival > _PARTLY * step.whole
        if (near or may_be) and not name.startswith("encoder_"):
            return None
        since = parts[0].end
        value, unit = (size, "m") if size > turned * self._reach else (turned, "rad")
        before = self.alarms[-1] if self.alarms and self.seconds - self._last_step < _SAME_BURST else None
        self._last_step = self.seconds
        is_open = not self.settled and self._open_at == len(self.alarms) - 1
        if before is not None and before.name.startswith(_PASSING) and not is_open:  # it goes on
            since = Moment(before.since, before.since_t, now.metres - before.detected_after_m)
            value += (before.value or 0.0) if unit == before.unit else 0.0
            if before.kind != "reference" and kind != "fault":
                name, kind = before.name, before.kind
            elif before.kind == "reference" and kind == "reference":
                name, kind = "push", "burst"
            self.alarms.pop()
        return Alarm(
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

    def _name_of_step(self, step: Step, parts: Sequence[_Recent], size: float) -> tuple[str, Kind]:
        """The name of a step of ``size`` m in some stretches."""
        matrix, turn = self.calibration.matrix_array, rotation(float(self._filter.state[2]))
        names = self.calibration.robot.wheel_names
        # How much of it the motion of each wheel explains.
        explained = []
        for low, high in pairwise([*self.predictor.columns.tolist(), matrix.shape[1]]):
            along = turn @ matrix[:, low:high]
            score = along.T @ step.score
            explained.append(float(score @ np.linalg.lstsq(along.T @ step.information @ along, score)[0]) / 2)
        still = {wheel for part in parts for wheel in part.stretch.still}
        silent = max(still, key=lambda wheel: explained[wheel], default=None)
        if silent is not None and explained[silent] > _MOSTLY * step.whole:
            return f"encoder_{names[silent]}", "fault"
        wheel = int(np.argmax(explained))
        if explained[wheel] > _MOSTLY * step.whole and len(explained) == len(names):
            self._steps_of[wheel] = self._steps_of.get(wheel, 0) + 1
            if self._steps_of[wheel] > _PERSISTENT:
                return f"slip_{names[wheel]}", "fault"
        else:
            self._steps_of.clear()
        seconds = float(np.mean([part.stretch.seconds for part in parts]))
        if size / max(seconds, 1e-9) > max(_WRONG_SPEED, 1.5 * self._filter.fastest):
            return "reference_jump", "reference"
        return "push" if sum(part.stretch.rolled for part in parts) < size / 2 else "slip", "burst"

    def _enter(self) -> list[Alarm]:
        """Add the oldest stretch to the block, which is judged when it is long enough."""
        oldest = self._recent.popleft()
        weight, whole, score = oldest.innovation.weight, oldest.innovation.whole, oldest.innovation.score
        none = np.zeros(len(self.hypotheses.names))
        stretch = _Block(weight * whole, weight * score, oldest.end, oldest.stretch.rolled, none)
        if self._block is None:
            self._block = stretch
        else:
            self._block.join(stretch)
        if self._block.rolled < _METRES:
            return []
        # Close the block. Older ones are joined by twos, so that windows of all lengths remain.
        block, self._block = self._block, None
        directions = self.hypotheses.directions
        along = np.maximum(_along(block.whole, directions), _LEAST)
        block.count, block.scatter = 1, (block.score @ directions) ** 2 / along
        self._filter.keep()
        self._blocks.append(block)
        size = 1
        while sum(each.count == size for each in self._blocks) > _ALIKE:
            first = next(k for k, each in enumerate(self._blocks) if each.count == size)
            self._blocks[first].join(self._blocks.pop(first + 1))
            size *= 2
        # Judge all of them, and what is in shadow.
        verdict = self._verdict()
        self.history.append((self.metres, verdict.h))
        self._ratio = float(np.median(verdict.ratio))
        self._weigh(block, verdict)
        if not self._blocks or (self.settled and verdict.h[verdict.best] <= THRESHOLD):
            return []
        return self._tell(verdict)

    def _verdict(self) -> _Verdict:
        """Eq. (G3) and (G4) for changes since each of the blocks."""
        directions, prior, identity = self.hypotheses.directions, self._prior, np.eye(len(self._prior))
        whole, score, numbers = (
            np.array([getattr(block, name) for block in self._blocks]) for name in ("whole", "score", "count")
        )
        freedom = self._freedom + max(int(numbers.sum()) - 2, 0)
        ratios = self._birge_ratios(_along(whole, directions), score @ directions, numbers)
        # A reference that drifts errs at the ends of a window, however long that is; what is more is a change.
        drift = min(self._filter.noise.drift, _DRIFTING)
        ratios *= 1 + (drift - 1) / numbers[::-1].cumsum()[::-1, None]
        common = np.median(ratios, axis=1)
        # What the blocks before tell of what the calibration does not know, and what is left of it.
        before, before_score = (np.cumsum(rows, axis=0) - rows for rows in (whole, score))
        after, after_score = whole.sum(axis=0) - before, score.sum(axis=0) - before_score
        before, after = (rows / common[:, None, None] for rows in (before, after))
        known = np.linalg.solve(identity + prior @ before, np.broadcast_to(prior, before.shape))
        mean = np.einsum("fqr,fr->fq", known, before_score / common[:, None])
        left = after_score / common[:, None] - np.einsum("fqr,fr->fq", after, mean)
        known = known + _WANDERING * (prior - known)
        # What all that leaves of the blocks since, along each hypothesis.
        joint = np.linalg.solve(identity + after @ known, np.concatenate([after, left[:, :, None]], axis=2))
        along = np.maximum(_along(joint[:, :, :-1], directions), _LEAST)
        slope = joint[:, :, -1] @ directions
        shrunk = np.minimum(common[:, None] / ratios, 1.0)
        square = shrunk * slope**2 / along
        h = (freedom + 1) / 2 * np.log1p(square / freedom)
        # With few degrees of freedom the tail of Student's t is heavier than that.
        tail = 2 * stdtr(np.broadcast_to(freedom, h.shape), -np.sqrt(square))
        h = np.minimum(h, -np.log(np.maximum(tail, np.finfo(float).tiny)))
        h[np.abs(slope / along) > self.hypotheses.largest] = 0.0
        row = int(h.max(axis=1).argmax())
        deviation = np.sqrt(1 / along[row] / shrunk[row])
        return _Verdict(h[row], slope[row] / along[row], deviation, ratios[row], row)

    def _birge_ratios(self, a: Array, b: Array, numbers: Array) -> Array:
        """Birge's ratios (F, P) for a change at each of F blocks: the largest over some lengths of blocks.

        a, b (F, P): d' A d and d' b of each block along each hypothesis, of ``numbers`` (F,) blocks each.
        """
        ratios = np.full(a.shape, _LEAST_RATIO)
        for scale in _SCALES:
            places = (np.cumsum(numbers) - numbers) // scale
            begins = np.diff(places, prepend=-1) > 0
            edges = np.flatnonzero(begins)
            ga, gb, sizes = (np.add.reduceat(rows, edges, axis=0) for rows in (a, b, numbers))
            if scale == 1:
                within = np.array([block.scatter for block in self._blocks])
            else:
                within, sizes = gb**2 / np.maximum(ga, _LEAST), np.ones(len(edges))
            before, free_before = _scatter_within(ga, gb, within, sizes)
            after, free_after = (rows[::-1] for rows in _scatter_within(ga[::-1], gb[::-1], within[::-1], sizes[::-1]))
            # Groups wholly after, and wholly before.
            right = np.searchsorted(edges, np.arange(len(a)))
            left = np.where(begins, right, np.maximum(right - 1, 0))
            stated, free = max(self._freedom / scale, _LEAST_STATED), (free_before[left] + free_after[right])[:, None]
            ratio = (stated * self._usual_ratio + before[left] + after[right]) / (stated + free)
            ratios = np.maximum(ratios, ratio)
        return ratios

    def _tell(self, verdict: _Verdict) -> list[Alarm]:
        """Tell a change, or more of the one that is open; propose its value, and go on from it when it is settled."""
        best, hypotheses = verdict.best, self.hypotheses
        if verdict.h[best] > THRESHOLD or self.settled:
            alarm = self._alarm_of(verdict)
            if self.settled:
                self._open_at, self._told_at = len(self.alarms), self.metres
                self.alarms.append(alarm)
            else:
                self._retell(alarm)
            self._alarm = best
        alarm = self.alarms[self._open_at]
        assert self._alarm is not None
        named, change = self._alarm, float(verdict.change[self._alarm])
        variance = float(verdict.deviation[named]) ** 2
        proposable = alarm.kind == "change" and hypotheses.names[named] != "floor" and not alarm.alternatives
        if proposable and self._shadow is None:
            value = self._value_of(named, change)
            self._shadow = _Trial(len(self.proposals), named, change, self.metres)
            self.proposals.append(Proposal(name=hypotheses.names[named], value=value, since=alarm.since))
        elif not proposable and not alarm.alternatives and self.metres - self._told_at > _SETTLED:
            self._adopt(named, change, variance)
        return [alarm]

    def _retell(self, alarm: Alarm) -> None:
        """Say of the open alarm what is known by now; when it was told first stays."""
        first = self.alarms[self._open_at]
        self.alarms[self._open_at] = alarm.model_copy(update={name: getattr(first, name) for name in _FIRST_TOLD})

    def _value_of(self, hypothesis: int, change: float) -> float:
        """The value of a parameter that has changed by so much since the last change that was adopted."""
        return float(self.hypotheses.values[hypothesis] + self._adopted.get(hypothesis, 0.0) + change)

    def _alarm_of(self, verdict: _Verdict) -> Alarm:
        """The alarm of the best hypothesis."""
        best, hypotheses = verdict.best, self.hypotheses
        now, since = self._blocks[-1].since, self._blocks[verdict.first].since
        name, kind = hypotheses.names[best], hypotheses.kinds[best]
        value = self._value_of(best, float(verdict.change[best]))
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
        sizes = np.maximum(np.linalg.norm(motions[:, :2], axis=1), 0.1)

        def effect(hypothesis: int) -> Array:
            """What a change does to each motion (3, D), m."""
            change = self.hypotheses.directions[:size, hypothesis] * verdict.change[hypothesis]
            moved: Array = change.reshape(3, -1) @ signals
            moved[2] *= self._reach
            return moved / sizes

        own = effect(best)
        apart = np.min([np.linalg.norm(own - effect(other), axis=0) for other in others], axis=0)
        if not apart.max() > _ALIKE_EFFECT * np.linalg.norm(own):
            return "no motion tells them apart"
        motion = motions[int(apart.argmax())]
        if abs(motion[2]) > _TURNING:
            return "drive a curve" if isinstance(self.calibration.robot.drive, CarDrive) else "turn on the spot"
        return "drive sideways" if abs(motion[1]) > abs(motion[0]) else "drive straight"

    def _weigh(self, block: _Block, verdict: _Verdict) -> None:
        """Judge what was accepted, and the proposal in shadow, by a new block."""
        level = math.log(len(self.proposals) * (len(self.proposals) + 1) / _ALPHA) if self.proposals else 0.0
        a, b = _along(block.whole, self.hypotheses.directions), block.score @ self.hypotheses.directions
        for accepted in self._accepted:
            named, change = accepted.hypothesis, accepted.change
            accepted.log_e -= float(change * b[named] + change**2 * a[named] / 2) / float(verdict.ratio[named])
            if accepted.log_e > level:
                self._note(accepted, rolled_back=True, reason="predicts later motion worse after all")
                self._adopt(named, -change, 0.0)
                self._accepted.remove(accepted)
                return
            if self.settled and self._refined(accepted, float(verdict.ratio[named])):
                return
        trial = self._shadow
        if trial is None:
            return
        named, change = trial.hypothesis, trial.change
        trial.log_e += float(change * b[named] - change**2 * a[named] / 2) / float(verdict.ratio[named])
        trial.without += float(block.scatter[named])
        trial.within += float((b[named] - change * a[named]) ** 2 / max(a[named], _LEAST))
        other = verdict.best
        ousted = other != named and verdict.h[other] > verdict.h[named] + _APART
        sure = other == named and float(np.partition(verdict.h, -2)[-2]) < verdict.h[named] - _APART
        holds: bool | None = None
        reason = ""
        if trial.log_e > level and sure:
            holds, reason = True, "predicts later motion better"
            trial.change, trial.variance = float(verdict.change[named]), float(verdict.deviation[named]) ** 2
            self._retell(self._alarm_of(verdict))
        elif ousted:
            holds, reason = False, f"{self.hypotheses.names[other]} explains it better"
        elif trial.log_e < -level:
            holds, reason = False, "predicts later motion worse"
        ratio = math.sqrt(trial.within / trial.without) if trial.without > 0 else None
        held_out = HeldOut(metres=self.metres - trial.begun, log_e=trial.log_e, error_ratio=ratio)
        self._note(trial, accepted=holds, reason=reason, held_out=held_out)
        if holds:
            self._adopt(named, trial.change, trial.variance)
            self._note_value(trial)
            trial.log_e = 0.0
            self._accepted = [*(each for each in self._accepted if each.hypothesis != named), trial]
        elif holds is False:
            self._shadow = None
            if verdict.h[other] <= THRESHOLD:  # it has passed
                del self._blocks[verdict.first :]
                self._alarm = None

    def _refined(self, trial: _Trial, ratio: float) -> bool:
        """Take an accepted change for what the motion since then says of it; False until that is twice as sure."""
        direction = self.hypotheses.directions[:, trial.hypothesis]
        others = self._prior - trial.variance * direction[:, None] * direction
        whole, score = (sum(getattr(block, name) for block in self._blocks) / ratio for name in ("whole", "score"))
        joint = np.linalg.solve(np.eye(len(others)) + whole @ others, np.column_stack([whole, score]))
        variance = 1 / (1 / trial.variance + float(direction @ joint[:, :-1] @ direction))
        if 4 * variance > trial.variance:
            return False
        change = variance * float(direction @ joint[:, -1])
        self._adopt(trial.hypothesis, change, variance - trial.variance)
        trial.change, trial.variance = trial.change + change, variance
        self._note_value(trial)
        return True

    def _note_value(self, trial: _Trial) -> None:
        """Write down the value of an accepted proposal, with its 95 % interval."""
        value, reach = self._value_of(trial.hypothesis, 0.0), 1.96 * math.sqrt(trial.variance)
        self._note(trial, value=value, low=value - reach, high=value + reach)

    def _note(self, trial: _Trial, **update: object) -> None:
        """Write down how a proposal does."""
        self.proposals[trial.number] = self.proposals[trial.number].model_copy(update=update)

    def _adopt(self, named: int, change: float, variance: float) -> None:
        """Go on from a change: what comes is compared with it, as sure as its value is."""
        direction = self.hypotheses.directions[:, named]
        self._assumed = self._assumed + change * direction
        self._adopted[named] = self._adopted.get(named, 0.0) + change
        late = change if self.hypotheses.names[named] == "reference_clock" else 0.0
        self._filter.change(change * direction, late)
        self._prior = self._prior + variance * direction[:, None] * direction
        self._usual_ratio = self._verdict().ratio
        self._freedom = min(self._freedom + sum(block.count for block in self._blocks), _LONGEST_MEMORY)
        self._blocks.clear()
        self._recent.clear()
        self._alarm, self._shadow = None, None

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

    def drives_with(self, changes: Mapping[str, float]) -> None:
        """Take it that the robot drives with changes of parameters from now on, which stretches then hold."""
        names = self.hypotheses.names
        self._driven_with = np.zeros(len(self._assumed))
        for name, value in changes.items():
            self._driven_with += value * self.hypotheses.directions[:, names.index(name)]


def _rows(matrix: Array, change: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, (matrix + change.reshape(matrix.shape)).tolist()))


def _along(whole: Array, directions: Array) -> Array:
    """d' A d (..., P) of matrices (..., q, q), for each of the directions (q, P)."""
    return np.einsum("qp,...qp->...p", directions, whole @ directions)


def _scatter_within(a: Array, b: Array, within: Array, groups: Array) -> tuple[Array, Array]:
    """Scatter (G + 1, P) of the first blocks' estimates about their mean, and its degrees of freedom (G + 1,)."""
    none = np.zeros((1, a.shape[1]))
    sums = [np.concatenate([none, np.cumsum(rows, axis=0)]) for rows in (a, b, within)]
    squares = np.maximum(sums[2] - sums[1] ** 2 / np.maximum(sums[0], 1e-12), 0.0)
    return squares, np.maximum(np.concatenate([[0.0], np.cumsum(groups)]) - 1, 0.0)
