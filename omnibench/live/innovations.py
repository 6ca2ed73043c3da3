"""The filter whose innovations the guard judges: reference poses against the motion that a calibration predicts.

An extended Kalman filter follows the pose of the tracked point (x, y, heading), the delay of the reference's stamps and
the offset of its heading. Beside its state it carries the derivatives of the state by all that may have changed, Eq.
(G1) of ``guard``, and by a step of the pose at each of the last stretches.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from omnibench.live.odometry import UNKNOWN_NOISE
from omnibench.live.stretches import LEAST_STEP, Stretch
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, pose_covariance, rotation

# All are chosen, but for the quantiles of chi-square.
RECENT: Final = 8  # number of the last stretches, at which a step is looked for, and which are in no block yet
_CLIP: Final = 4.0  # norm of an innovation in standard deviations, beyond which it is clipped (Huber)
_VAGUE: Final = 10.0  # factor on the deviation of the pose with which the filter begins, which may be an outlier
_CLEAR: Final = 3.0  # least size of a step in standard deviations of a pose
_OFFSET: Final = 0.003  # rad, least standard deviation of a reference's heading offset in a run
_LEAST_DEVIATION: Final = 1e-4  # m, rad: no reference is more exact

_SQUARES: Final = 32  # number of innovations of which the median is taken
_REMEMBERED: Final = 256  # number of innovations whose tail is compared with that of normal ones
_RARE: Final = 9.837  # 0.98 quantile of chi-square with 3 degrees of freedom
_MEDIAN: Final = 2.366  # median of chi-square with 3 degrees of freedom


class ReferenceNoise:
    """How much more the reference scatters than it states, by its whitened innovations.

    scale: of its variance. tail: of the 0.98 quantile of squares. drift: of the variance of the sum of some in a row,
    larger where errors last. All are 1 at least; a tail is expected until it is known.
    """

    def __init__(self) -> None:
        self.scale, self.tail, self.drift = 1.0, 4.0, 1.0
        self._last: Array = np.zeros(3)
        self._sum: Array = np.zeros(3)
        self._count = 0
        self._squares: deque[float] = deque(maxlen=_REMEMBERED)
        self._sums: deque[float] = deque(maxlen=_SQUARES)

    def begin(self) -> None:
        """Begin a run."""
        self._last = np.zeros(3)

    def take(self, white: Array) -> None:
        """Take a whitened innovation (3,)."""
        # By differences from one to the next, in which what changed cancels out.
        self._squares.append(float(np.square(white - self._last).sum()) / 2)
        self._last, self._sum, self._count = white, self._sum + white, self._count + 1
        if self._count % RECENT == 0:
            self._sums.append(float(np.square(self._sum).sum()) / RECENT)
            self.drift = max(1.0, float(np.median(self._sums)) / _MEDIAN)
            self._sum = np.zeros(3)
        if self._count % _SQUARES == 0:
            self.scale = max(1.0, self.scale * float(np.median(list(self._squares)[-_SQUARES:])) / _MEDIAN)
            self.tail = max(1.0, float(np.quantile(self._squares, 0.98)) / _RARE)


_DELAY: Final = 0.1  # standard deviation of the delay of a reference's stamps when a run begins, s
_RUNS: Final = 2.0  # number of runs for which that counts
_MOST_DELAYS: Final = 5000  # number of runs whose delay is remembered
_LASTING: Final = 0.8  # share of a change of velocity at which a delay still shows after another stretch
_FASTER: Final = 0.02  # least change of velocity at which a delay shows, m/s
_ASIDE: Final = 0.3  # largest share of a delay's step across the velocity before
_LATEST: Final = 2.0  # longest delay of a reference, s


class Delay:
    """The delay of the reference's stamps, which may differ from run to run: its mean, s, and its variance, s2.

    A delay that is not the mean shows while the velocity changes.
    """

    def __init__(self) -> None:
        self.mean, self.variance = 0.0, _DELAY**2
        self._seen: deque[float] = deque(maxlen=_MOST_DELAYS)
        self._recent: Array = np.zeros((3, 3))
        self._change: Array = np.zeros(3)
        self._changed_at = -math.inf

    def begin(self) -> None:
        """Begin a run."""
        self._recent = np.zeros((3, 3))

    def learn(self, delay: float) -> None:
        """Take the delay of a run, s."""
        self._seen.append(delay)
        spread = np.square(np.array(self._seen) - np.mean(self._seen)).sum() + _RUNS * _DELAY**2
        self.variance = float(spread) / (_RUNS + len(self._seen))

    def covariance(self, change: Array, now: float) -> Array:
        """Covariance (3, 3) of a pose after the velocity changed by (3,) in the last stretch. now: s."""
        self._recent = _LASTING * self._recent + change[:, None] * change
        if np.hypot(change[0], change[1]) > _FASTER:
            self._change, self._changed_at = change, now
        return self.variance * self._recent

    def explains(self, step: Array, now: float) -> bool:
        """True if a step (3,) of a robot that stands is the rest of the way that the reference was late by."""
        if now - self._changed_at > _LATEST:
            return False
        late = float(step @ self._change / (self._change @ self._change))
        if abs(late) > _LATEST or np.linalg.norm(step - late * self._change) > _ASIDE * np.linalg.norm(step):
            return False
        self.learn(late)
        return True


@dataclass(frozen=True, eq=False)
class Innovation:
    """The information of one pose on q: A (q, q) and b (q,) of Eq. (G2); weight: below 1 where the pose is far off."""

    whole: Array
    score: Array
    weight: float


@dataclass(frozen=True, eq=False)
class Step:
    """A step (3,) of the pose in the map at the first of the ``last`` stretches.

    gain: log-likelihood ratio that it explains, where one innovation counts as much as a clipped one at most; whole:
    without that. information (3, 3), score (3,): on the step.
    """

    step: Array
    last: int
    gain: float
    whole: float
    information: Array
    score: Array


class PoseFilter:
    """The filter. ``begin`` each run at a pose, then ``take`` each stretch and the pose after it.

    state (5,): x, y, heading, m, m, rad; delay, s; heading offset, rad. deviation (5, q): B of Eq. (G1). seconds: so
    far. fastest: speed so far, m/s. moving: in the last stretch.
    """

    def __init__(self, calibration: Calibration, count: int) -> None:
        noise = calibration.noise or UNKNOWN_NOISE
        place, heading = (max(each, _LEAST_DEVIATION) for each in (noise.pose_position, noise.pose_heading))
        self._usual, self._least = pose_covariance(place, math.degrees(heading)), _LEAST_DEVIATION**2 * np.eye(3)
        self._offset = max(noise.bias_heading, _OFFSET)
        self.noise, self.delay = ReferenceNoise(), Delay()
        self.state: Array = np.zeros(5)
        self.covariance: Array = np.zeros((5, 5))
        self.deviation: Array = np.zeros((5, count))
        self.seconds = self.fastest = 0.0
        self.moving = self.begun = False
        self._velocity: Array = np.zeros(3)  # at the last pose, in the map
        self._pose: Array = np.zeros(3)  # the last one
        self._spread: Array = np.zeros((3, 3))  # its covariance, as it scatters
        # Derivatives (R, 5, 3) of the state by a step at each of the last R stretches; and, side by side (R, 3, 5), the
        # information on each step, its score, and its clipped score.
        self._steps: Array = np.zeros((0, 5, 3))
        self._step_sums: Array = np.zeros((0, 3, 5))
        self.keep()

    def begin(self, pose: Array, covariance: Array | None) -> None:
        """Begin a run at a reference pose (3,) with its covariance (3, 3); None: the calibration's."""
        if self.begun:  # delays that differ from run to run are no change of the reference
            self.delay.learn(float(self.state[3]))
        self.state = np.array([*pose.tolist(), self.delay.mean, 0.0])
        self.covariance = np.zeros((5, 5))
        self.covariance[:3, :3] = _VAGUE**2 * (self._usual if covariance is None else covariance + self._least)
        self.covariance[3, 3], self.covariance[4, 4] = self.delay.variance, self._offset**2
        self._be_turned()
        self.deviation = np.zeros_like(self.deviation)
        self.noise.begin()
        self.delay.begin()
        self.keep()
        self._forget_steps()
        self.begun = False

    def take(self, stretch: Stretch, pose: Array, covariance: Array | None, change: Array) -> Innovation:
        """Take a stretch, in which q is off by ``change`` (q,), and the reference pose (3,) at its end."""
        self.seconds += stretch.seconds
        speed = stretch.way / max(stretch.seconds, 1e-9)
        self.fastest, self.moving = max(self.fastest, speed), speed > _FASTER
        # Predict, Eq. (G1).
        turn = rotation(float(self.state[2]))
        slopes = turn @ stretch.slopes
        if not self.begun:  # what the reference tells of a robot that moves already is late
            self._be_late(turn @ stretch.begun)
            self.begun = True
        moved = turn @ stretch.moved + slopes @ change
        self.state[:3] += moved
        transition = np.eye(5)
        transition[0, 2], transition[1, 2] = -moved[1], moved[0]
        self.covariance = transition @ self.covariance @ transition.T
        self.covariance[:3, :3] += turn @ stretch.spread @ turn.T
        self.deviation = transition @ self.deviation
        self.deviation[:3] += slopes
        self._steps = np.concatenate([transition @ self._steps, np.eye(5, 3)[None]])[-RECENT:]
        self._step_sums = np.concatenate([self._step_sums, np.zeros((1, 3, 5))])[-RECENT:]
        # Compare with the reference.
        self._velocity = turn @ stretch.velocity
        measured = np.zeros((3, 5))
        measured[:, :3], measured[:, 3], measured[2, 4] = np.eye(3), -self._velocity, 1.0
        innovation = pose - measured @ self.state
        innovation[2] -= math.tau * round(float(innovation[2]) / math.tau)
        noise = self._usual if covariance is None else covariance + self._least
        spread = measured @ self.covariance @ measured.T + self.noise.scale * noise
        spread += self.delay.covariance(turn @ (stretch.velocity - stretch.begun), self.seconds)
        self.noise.take(np.linalg.solve(np.linalg.cholesky(spread), innovation))
        self._pose, self._spread = pose, self.noise.scale * noise
        information = np.linalg.inv(spread)
        square = float(innovation @ information @ innovation)
        weight = min(1.0, _CLIP / math.sqrt(max(square, 1e-12)))
        slope = measured @ self.deviation
        slope[:, -1] -= self._velocity
        # Add to what is known of a step at each of the last stretches.
        by_step = measured @ self._steps
        score = np.swapaxes(by_step, 1, 2) @ (information @ innovation)
        self._step_sums[:, :, :3] += np.swapaxes(by_step, 1, 2) @ information @ by_step
        self._step_sums[:, :, 3:] += score[:, :, None] * [1.0, weight]
        # Correct.
        gain = weight * self.covariance @ measured.T @ information
        self.state += gain @ innovation
        self.covariance -= gain @ measured @ self.covariance
        self.deviation -= gain @ slope
        self._steps = self._steps - gain @ by_step
        by_change = slope.T @ information
        return Innovation(by_change @ slope, by_change @ innovation, weight)

    def step(self, tail: float, reach: float) -> Step | None:
        """The step of the pose that explains the last innovations best; None: it is too small to be told from noise.

        tail: factor on the squares of innovations. reach: m that a wheel rolls for a turn by 1 rad.
        """
        regular = self._step_sums[:, :, :3] + 1e-9 * np.eye(3)
        steps, clipped = np.moveaxis(np.linalg.solve(regular, self._step_sums[:, :, 3:]), 2, 0)
        gains = np.einsum("ij,ij->i", self._step_sums[:, :, 4], clipped) / (2 * tail)
        at = int(gains.argmax())
        step, score = steps[at], self._step_sums[at, :, 3]
        least = max(LEAST_STEP, _CLEAR * math.sqrt((self._spread[0, 0] + self._spread[1, 1]) / 2))
        if max(math.hypot(step[0], step[1]), abs(float(step[2])) * reach) < least:
            return None
        return Step(step, len(steps) - at, float(gains[at]), float(score @ step) / 2, regular[at], score)

    def anchor(self) -> None:
        """Begin again at the last pose, with delay and offset as they were when they were kept."""
        self.state[3:], self.covariance[3:, 3:] = self._kept
        self.state[:3] = self._pose
        self.state[2] -= self.state[4]
        self.covariance[:3, 3:] = self.covariance[3:, :3] = 0.0
        self.covariance[:3, :3] = _VAGUE**2 * self._spread
        self._be_turned()
        self.deviation[:] = 0.0
        self._be_late(self._velocity)
        self._forget_steps()

    def keep(self) -> None:
        """Keep the delay and the offset for ``anchor``."""
        self._kept = self.state[3:].copy(), self.covariance[3:, 3:].copy()

    def change(self, change: Array, delay: float) -> None:
        """Go on as if q had been off by ``change`` (q,) since the filter began, and the reference late by ``delay``."""
        self.state = self.state + self.deviation @ change
        self.delay.mean += delay
        self.state[3] += delay
        self._forget_steps()

    def _be_turned(self) -> None:
        """Correct a pose that was taken as it was measured for the offset's variance."""
        variance = self.covariance[4, 4]
        self.covariance[2, 2] += variance
        self.covariance[2, 4] = self.covariance[4, 2] = -variance

    def _be_late(self, velocity: Array) -> None:
        """Correct a pose that was taken as it was measured for the delay, at a velocity (3,) in the map."""
        delayed = np.array([*velocity.tolist(), 1.0, 0.0])
        variance, self.covariance[3, 3] = float(self.covariance[3, 3]), 0.0
        self.covariance += variance * delayed[:, None] * delayed
        self.state[:3] += velocity * self.state[3]

    def _forget_steps(self) -> None:
        self._steps, self._step_sums = self._steps[:0], self._step_sums[:0]
