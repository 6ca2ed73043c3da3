"""Offset and drift of a reference's clock against the wheels', run by run, from what both show of the same motion.

A pose stamped t by the reference's clock was taken at

    tau(t) = t + offset + drift (t - t0)                                                        (1)

of the wheels' clock, t0 being the run's first stamp. Between stamps t_i and t_j about a second apart the heading
changes by

    theta_j - theta_i = h . (C(tau_j) - C(tau_i)) + e,                                          (2)

C (M) being the integrals of the drive signals, and the tracked point moves by

    |p_j - p_i| = s . (A(tau_j) - A(tau_i)) + e,                                                (3)

A (M + 1) being the integrals of the design's speed and of the signals' magnitudes. h and s are fitted with the clocks,
so that a wrong matrix, swapped wheels, other units and a mirrored reference do not matter: shapes are matched, not
values. They are common to all runs that are given: a run that drives one command alone may hide its clock in them.

Eq. (2) and (3) are solved by Gauss-Newton with Huber's weights; a step that does not lower Huber's loss is halved, as
without that clocks that hardly show step to and fro for ever. Standard errors are of the sandwich kind, of scores
that are summed over blocks, as slip lasts; or of independent residuals where those are larger, since few blocks scatter
too little by chance (Angrist and Pischke 2009, section 8.2.3, take the larger of the two as well). Lags that change
with the speed, as those of slow encoders, feign a drift: its error is that of a few long blocks where that is larger.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array, Robot

_WINDOW = 1.0  # s between the stamps of Eq. (2): long beside a pose's noise, short beside the drift by slip; chosen
_BIN = 0.2  # s: poses within are averaged, so that dense ones cost no more than sparse ones; chosen
# A drift's error is told by so many long blocks of a run, few enough that a change of speed lasts through one (chosen).
# So few scatter too little by chance: _FEW is the quantile of Student's t with 7 degrees of freedom over that of the
# normal distribution at 4 standard deviations (Ibragimov and Mueller 2010).
_LONG_BLOCKS, _FEW = 8, 2.3
_BLOCK = 2.0  # s: residuals that are nearer count as correlated; chosen, twice the window
SEARCH = 2.0  # s: offsets are looked for within this on either side, unless the caller says more; chosen
_COARSE = 0.1  # s between the offsets that are tried first, a tenth of the window
_MOST_BINS = 40_000  # offsets times bins that are looked at together; chosen: some MB
_HUBER = 1.5  # standard deviations from which on a residual counts less
ROUNDS = 30  # at most so many alternations of the fit of h and s with that of the clocks; chosen
_STEPS, _HALVINGS = 4, 4  # at most so many Gauss-Newton steps of a clock in each round, and halvings of each; chosen
_SETTLED = 1e-4  # s: steps of the clocks that are shorter change nothing; below _CHORDS
_FEWEST = 10  # windows of a run, below which its clock is not told; chosen
_LEAST_DRIFTING = 10.0  # s: the drift of a shorter run is not told apart from its offset; chosen
_LARGEST_DRIFT = 0.05  # s per s: no clock goes more wrong; OptiOdom's tricycle has 0.014
_DELTA = 0.01  # s: half the step of derivatives by time
# s: standard deviation that chords in place of arcs, Eq. (3), add to an offset. Chosen by 200 simulated drives each at
# 10, 20 and 50 Hz: with it 99 % of their errors are within 2.3 of the standard errors that are given, without 5.
_CHORDS = 2e-4
# Robust cost that an offset _AWAY, s, from the best one must add, as a share. Chosen: every run of four robots under
# motion capture (OptiOdom) adds 0.43 or more, and the 72 of a Robotino that drives evenly throughout add 0.07 or less.
_AWAY, _TOLD = 0.5, 0.2
# Standard deviations by which what the wheels explain changes at least; chosen: turns on the spot show 0.6 in the way,
# drives that tell a clock 80 or more.
_CHANGES = 3.0
_FINE = 60  # ticks in a sample at most, of counters that are coarse; chosen
_NOW = np.zeros(1)  # s
_RANK = 1e-3  # of the strongest direction of the signals: what is weaker is noise; chosen


@dataclass(frozen=True, eq=False)
class Streams:
    """Wheels and reference of one run, each by its own clock.

    edges (F + 1,): begin of the first wheel sample and end of each, s. driven (F + 1, M): integrals of the drive
    signals up to then, rad. pose_times (K,): s. poses (K, 3): m, m and rad, headings continuous.
    """

    edges: Array
    driven: Array
    pose_times: Array
    poses: Array

    @classmethod
    def of_run(cls, run: Trajectory) -> Streams:
        """The streams of a run of a data set."""
        edges = np.append(0.0, run.times)
        moved = run.signals * np.diff(edges)[:, None]
        return cls(edges, np.vstack([np.zeros(moved.shape[1]), np.cumsum(moved, axis=0)]), run.pose_times, run.poses)


@dataclass(frozen=True)
class ClockMatch:
    """The clock of a run's reference against its wheels', Eq. (1), with standard errors.

    middle, middle_error: s to add to the poses' times in the run's middle, where it shows best. drift, drift_error: s
    per s; 0 and infinite where the run is too short to tell. length: of the reference, s. freedom: degrees of freedom
    of Student's t that the errors have, by the windows that share nothing.
    """

    middle: float
    middle_error: float
    drift: float
    drift_error: float
    length: float
    freedom: float

    @property
    def offset(self) -> float:
        """Seconds to add to the times of the run's first pose."""
        return self.middle - self.drift * self.length / 2

    def corrected(self, pose_times: Array) -> Array:
        """Pose times (K,) by the wheels' clock, s, Eq. (1)."""
        return np.asarray(pose_times + self.offset + self.drift * (pose_times - pose_times[0]))


def match_clocks(robot: Robot, runs: Sequence[Streams], search: float = SEARCH) -> list[ClockMatch | None]:
    """The clock of the reference in every run; None where a run is too short or too even to tell.

    search: s, the largest offset that is looked for. Runs of one robot are told better together than alone.
    """
    windows = [Windows.of(robot, run) for run in runs]
    usable = [each for each in windows if each is not None]
    if not usable:
        return [None] * len(runs)
    fitted, clocks = fitted_together(usable, search)
    matches = iter([each.match(fitted, clock, search) for each, clock in zip(usable, clocks, strict=True)])
    return [None if each is None else next(matches) for each in windows]


def fitted_together(windows: Sequence[Windows], search: float) -> tuple[list[Array], list[Clock]]:
    """The coefficients h and s, and the clocks, that fit runs best together."""
    clocks = [each.scanned(search) for each in windows]
    for _ in range(ROUNDS):
        before, within = clocks, [each.within(clock) for each, clock in zip(windows, clocks, strict=True)]
        changes = [each.columns(clock)[0] for each, clock in zip(windows, clocks, strict=True)]
        fitted = []  # the coefficients h and s, Eq. (2) and (3), that fit all runs best by their clocks
        for row, channel in enumerate(windows[0].channels):
            columns = np.concatenate([counts[chosen, channel] for counts, chosen in zip(changes, within, strict=True)])
            shown = np.concatenate([each.shown[row][chosen] for each, chosen in zip(windows, within, strict=True)])
            fitted.append(_solved(columns, shown, np.ones(len(shown), dtype=bool)))
        clocks = [each.improved(fitted, clock) for each, clock in zip(windows, clocks, strict=True)]
        pairs = zip(windows, before, clocks, strict=True)
        if max(each.farthest_step(*np.subtract(old, new)) for each, old, new in pairs) < _SETTLED:
            break
    return fitted, clocks


Clock = tuple[float, float]
"""Seconds to add in the middle of a run, and drift, s per s."""


@dataclass(frozen=True, eq=False)
class Windows:
    """The windows of a run: first and last (W,) of its bins, and what the reference shows between them.

    edges (F + 1,), counted (F + 1, C): times, s, and integrals of the signals, then of the design's speed and of the
    signals' magnitudes. channels: the columns that tell the heading, and those that tell the way. stamps (K,): s.
    starts (B,): first stamp of each bin. shown (2, W): change of heading, rad, and way, m. tick: usual time of one, s;
    0 of fine counters.
    steers: the way alone tells the clock, since wheels may follow their steering angles late.
    """

    edges: Array
    counted: Array
    channels: tuple[slice, slice]
    stamps: Array
    starts: NDArray[np.intp]
    first: NDArray[np.intp]
    last: NDArray[np.intp]
    shown: Array
    tick: float = 0.0
    steers: bool = False

    @classmethod
    def of(cls, robot: Robot, run: Streams) -> Windows | None:
        """The windows of a run; None if there are too few, or the wheels or the reference stand."""
        if len(run.pose_times) < _FEWEST or len(run.edges) < _FEWEST:
            return None
        bins = np.floor((run.pose_times - run.pose_times[0]) / _BIN)
        starts = np.flatnonzero(np.diff(bins, prepend=-1.0))
        moments = _means(run.pose_times[:, None], starts)[:, 0]
        apart = max(_WINDOW, 1.5 * float(np.median(np.diff(moments)))) if len(moments) > 1 else _WINDOW
        last = np.searchsorted(moments, moments + apart - _BIN / 2)
        first = np.flatnonzero(last < len(moments))
        first = first[moments[last[first]] - moments[first] < 1.5 * apart]
        last = last[first]  # windows with a gap between their ends are left out
        if len(first) < _FEWEST:
            return None
        poses = _means(run.poses, starts)
        moved = poses[last] - poses[first]
        driven = np.diff(run.driven, axis=0)
        twists = driven @ robot.inverse_kinematic_matrix.T
        speeds = np.column_stack([np.hypot(twists[:, 0], twists[:, 1]), np.abs(driven)])
        counted = np.hstack([run.driven, np.vstack([np.zeros(speeds.shape[1]), np.cumsum(speeds, axis=0)])])
        shown = np.array([moved[:, 2], np.hypot(moved[:, 0], moved[:, 1])])
        tick = _tick_time(driven, np.diff(run.edges))
        channels, steers = (slice(0, driven.shape[1]), slice(driven.shape[1], None)), bool(robot.drive.steered)
        return cls(run.edges, counted, channels, run.pose_times, starts, first, last, shown, tick, steers)

    @property
    def middle(self) -> float:
        """Middle of the run by the reference's clock, s."""
        return float(self.stamps[0] + self.stamps[-1]) / 2

    @property
    def length(self) -> float:
        """Length of the run by the reference's clock, s."""
        return float(self.stamps[-1] - self.stamps[0])

    def farthest_step(self, offset: float, drift: float = 0.0) -> float:
        """The most, s, that a step of the clock moves a stamp of the run."""
        return abs(float(offset)) + abs(float(drift)) * self.length / 2

    def columns(self, clock: Clock, later: Array = _NOW) -> Array:
        """Changes (L, W, C) of what the wheels count over the windows, ``later`` (L,), s, than by a clock."""
        times = self._pose_times(clock) + later[:, None]
        means = _means(_between(times, self.edges, self.counted), self.starts)
        return np.asarray(means[:, self.last] - means[:, self.first])

    def _pose_times(self, clock: Clock) -> Array:
        """Times (K,) of the poses by the wheels' clock, s, Eq. (1); a drift counts from the run's middle."""
        return self.stamps + clock[0] + clock[1] * (self.stamps - self.middle)

    def within(self, clock: Clock) -> NDArray[np.bool_]:
        """True (W,) for windows that lie within the wheels' samples by a clock."""
        return self._inside(self._pose_times(clock)[self.starts])

    def _inside(self, begins: Array) -> NDArray[np.bool_]:
        """True (..., W) for windows whose bins begin, at times (..., B), within the wheels' samples."""
        inside = (begins >= self.edges[0]) & (begins <= self.edges[-1] - _BIN)
        return np.asarray(inside[..., self.first] & inside[..., self.last])

    def scanned(self, search: float, fitted: Sequence[Array] | None = None) -> Clock:
        """The offset by which the run itself fits best, with coefficients of its own unless some are given."""
        steps = int(np.ceil(search / _COARSE))
        offsets = np.arange(-steps, steps + 1) * _COARSE
        parts = np.array_split(offsets, -(-len(offsets) * len(self.starts) // _MOST_BINS))
        return float(offsets[np.concatenate([self._unexplained(part, fitted) for part in parts]).argmin()]), 0.0

    def _unexplained(self, offsets: Array, fitted: Sequence[Array] | None) -> Array:
        """Products (L,) of the shares of heading and way that the wheels do not explain by offsets (L,), s.

        Bins count at their mean time, which is near enough for steps of _COARSE.
        """
        within = self._inside(self.stamps[self.starts] + offsets[:, None])
        moments = _means(self.stamps[:, None], self.starts)[:, 0]
        counts = _between(moments + offsets[:, None], self.edges, self.counted)
        columns = counts[:, self.last] - counts[:, self.first]
        shares = np.ones(len(offsets))
        for number, (channel, shown) in enumerate(zip(self.channels, self.shown, strict=True)):
            wanted = np.where(within, shown, 0.0)
            counted = columns[..., channel]
            solved = _solved(counted, wanted, within) if fitted is None else fitted[number]
            left = np.where(within, shown - (counted @ solved[..., None])[..., 0], 0.0)
            whole = (wanted**2).sum(axis=1)
            share = np.maximum((left**2).sum(axis=1) / np.maximum(whole, 1e-300), 1e-9)
            shares *= np.where((whole > 0) & (number == 1 or not self.steers), share, 1.0)
        shares[within.sum(axis=1) < max(_FEWEST, within.shape[1] / 2)] = np.inf
        return shares

    def _system(self, fitted: Sequence[Array], clock: Clock, deviations: Array | None = None) -> tuple[Array, ...]:
        """Residuals (2, W) in standard deviations (2,), Huber's weights, and derivatives (P, 2, W) of what is shown.

        deviations: by default those of what is left. The derivatives are by the gains of both channels in this run,
        since slip makes every window longer, and a drift does, too; by the offset; and, of a run that is long enough,
        by the drift, which the moments tell at which the motion changes.
        """
        before, now, after = self.columns(clock, np.array([-_DELTA, 0.0, _DELTA]))
        left = self.shown - self._explained(fitted, now)
        deviations = (self._deviations(left, clock) if deviations is None else deviations)[:, None]
        residuals = left / deviations
        weights = np.minimum(1.0, _HUBER / np.maximum(np.abs(residuals), 1e-12)) * self.within(clock)
        weights[: int(self.steers)] = 0.0
        slopes = self._explained(fitted, (after - before) / (2 * _DELTA)) / deviations
        rows = [*(np.eye(2)[:, :, None] * ((self.shown - left) / deviations)), slopes]
        if self.length >= _LEAST_DRIFTING:
            begins = self.stamps[self.starts]
            rows.append(slopes * ((begins[self.first] + begins[self.last]) / 2 - self.middle))
        return residuals, weights, np.array(rows)

    def _explained(self, fitted: Sequence[Array], columns: Array) -> Array:
        """Changes (2, W), rad and m, that changes (W, C) of the wheels' counts explain."""
        return np.array([columns[:, channel] @ each for channel, each in zip(self.channels, fitted, strict=True)])

    def _deviations(self, left: Array, clock: Clock) -> Array:
        """Robust standard deviations (2,) of what is left (2, W)."""
        sizes = np.abs(left[:, self.within(clock)])
        least = 1e-6 + 1e-3 * np.sqrt(np.mean(self.shown**2, axis=1))
        return least if not sizes.size else np.maximum(1.4826 * np.median(sizes, axis=1), least)

    def improved(self, fitted: Sequence[Array], clock: Clock, steps: int = _STEPS) -> Clock:
        """The clock after some steps of Gauss-Newton, which are halved until the run fits better."""
        deviations = self._deviations(self.shown - self._explained(fitted, self.columns(clock)[0]), clock)
        for _ in range(steps):
            residuals, weights, derivatives = self._system(fitted, clock, deviations)
            design = derivatives.reshape(len(derivatives), -1)
            normal, wanted = (design * weights.ravel()) @ design.T, design @ (weights * residuals).ravel()
            offset, drift = [*np.linalg.lstsq(normal, wanted)[0][2:].tolist(), 0.0][:2]
            offset = float(np.clip(offset, -0.2, 0.2))
            for _ in range(_HALVINGS):
                limited = float(np.clip(clock[1] + drift, -_LARGEST_DRIFT, _LARGEST_DRIFT))
                tried = clock[0] + offset, limited
                both = self.within(clock) & self.within(tried)
                if self._cost(fitted, tried, deviations, both) < self._cost(fitted, clock, deviations, both):
                    break
                offset, drift = offset / 2, drift / 2
            else:
                return clock
            clock = tried
            if self.farthest_step(offset, drift) < _SETTLED / 10:
                break
        return clock

    def _cost(self, fitted: Sequence[Array], clock: Clock, deviations: Array, counted: NDArray[np.bool_]) -> float:
        """Huber's loss of the windows (W,) that count by a clock, with gains of both channels that fit this run."""
        explained = self._explained(fitted, self.columns(clock)[0]) / deviations[:, None]
        left = self.shown / deviations[:, None] - explained
        weights = np.minimum(1.0, _HUBER / np.maximum(np.abs(left), 1e-12)) * counted
        gains = (weights * left * explained).sum(axis=1) / np.maximum((weights * explained**2).sum(axis=1), 1e-300)
        return float(_huber(left - gains[:, None] * explained)[int(self.steers) :, counted].sum())

    def _told(self, fitted: Sequence[Array], clock: Clock) -> bool:
        """True if the motion changes by more than it scatters, and other offsets fit clearly worse."""
        now, *others = self.columns(clock, np.array([0.0, -_AWAY, _AWAY]))
        present, counted = self.shown - self._explained(fitted, now), self.within(clock)
        deviations = self._deviations(present, clock)[:, None]
        changing = (self._explained(fitted, now)[:, counted] / deviations).std(axis=1)
        if changing[int(self.steers) :].max() < _CHANGES:
            return False
        best = present / deviations
        for away, columns in zip((-_AWAY, _AWAY), others, strict=True):
            both = counted & self.within((clock[0] + away, clock[1]))
            if both.sum() < _FEWEST:
                return False
            left = (self.shown - self._explained(fitted, columns)) / deviations
            cost, least = (float(_huber(each[int(self.steers) :, both]).sum()) for each in (left, best))
            if cost - least <= _TOLD * least:  # both are 0 where the reference stands still
                return False
        return True

    def match(self, fitted: Sequence[Array], clock: Clock, search: float) -> ClockMatch | None:
        """The clock with its standard errors; None if the run does not tell it.

        A clock beyond the search is chance: any clock suits a reference that stands still.
        """
        if abs(clock[0]) > search + _WINDOW or not self._told(fitted, clock):
            return None
        residuals, weights, derivatives = self._system(fitted, clock)
        design = derivatives.reshape(len(derivatives), -1)
        scores, inverse = derivatives * (weights * residuals), np.linalg.pinv((design * weights.ravel()) @ design.T)
        since = self.stamps[self.starts][self.first] - self.stamps[0]

        def sandwich(block: float) -> Array:
            """Variances (P,) by scores that are summed over blocks of some s."""
            begins = np.flatnonzero(np.diff(np.floor(since / block), prepend=-1.0))
            sums = np.add.reduceat(scores, begins, axis=2).reshape(len(design), -1)
            return np.asarray(np.diag(inverse @ (sums @ sums.T) @ inverse))

        free = max(float(weights.sum()) - len(design), 1.0)
        alike = inverse * float((weights * residuals**2).sum()) / free  # as if the residuals were independent
        # Chords, and the ticks of coarse counters, which scatter less than they are long, but in a pattern.
        least = _CHORDS * np.array([1, np.sqrt(12.0) / self.length]) + self.tick * np.array([0.25, 1 / self.length])
        variances = np.maximum(sandwich(_BLOCK), np.diag(alike))[2:]
        variances[1:] = np.maximum(variances[1:], _FEW**2 * sandwich(max(_BLOCK, self.length / _LONG_BLOCKS))[3:])
        errors = np.sqrt(variances + least[: len(design) - 2] ** 2)
        told = len(errors) > 1 and abs(clock[1]) < _LARGEST_DRIFT
        drift_error = float(errors[1]) if told else np.inf
        apart = min(len(weights[0]), self.length / _WINDOW)
        freedom = max((2 - self.steers) * apart - len(design), 1.0)
        return ClockMatch(clock[0], float(errors[0]), clock[1], drift_error, self.length, freedom)


def _tick_time(driven: Array, durations: Array) -> float:
    """The usual time, s, of a tick of counters with steps (F, M), which are whole numbers of it; 0 if they are not."""
    steps = np.abs(driven)
    moved = steps[steps > 1e-9 * max(float(steps.max(initial=0.0)), 1e-12)]
    if not len(moved):
        return 0.0
    ticks = moved / moved.min()
    if np.abs(ticks - np.round(ticks)).max() > 0.05 or ticks.max() > _FINE:
        return 0.0
    # Between the samples in which the wheel that turns most has counted, of which slow wheels leave many out.
    busiest = steps[:, steps.sum(axis=0).argmax()]
    counted = np.flatnonzero(busiest >= moved.min())
    intervals = np.diff(np.cumsum(durations)[counted])
    return float(np.median(intervals / busiest[counted[1:]]) * moved.min()) if len(intervals) else 0.0


def _huber(residuals: Array) -> Array:
    """Huber's loss of residuals in their standard deviations."""
    sizes = np.abs(residuals)
    return np.where(sizes < _HUBER, sizes**2 / 2, _HUBER * sizes - _HUBER**2 / 2)


def _solved(columns: Array, wanted: Array, counted: NDArray[np.bool_]) -> Array:
    """Least squares (..., C) with Huber's weights, of rows that count, along the directions that are driven.

    columns (..., W, C), wanted (..., W), counted (..., W). By the normal equations: _RANK is far above their rounding.
    """
    weights = counted.astype(float)
    solution = _weighted(columns, wanted, weights)
    for _ in range(2):
        sizes = np.abs(wanted - (columns @ solution[..., None])[..., 0])
        deviation = 1.4826 * _median(sizes, counted)[..., None]
        robust = counted * np.minimum(1.0, _HUBER * deviation / np.maximum(sizes, 1e-300))
        weights = np.where(deviation > 0, robust, weights)
        solution = _weighted(columns, wanted, weights)
    return solution


def _weighted(columns: Array, wanted: Array, weights: Array) -> Array:
    """Weighted least squares (..., C) along the directions that are driven."""
    turned = np.swapaxes(columns * weights[..., None], -1, -2)
    values, vectors = np.linalg.eigh(turned @ columns)
    driven = values > _RANK**2 * np.maximum(values[..., -1:], 1e-300)
    along = (np.swapaxes(vectors, -1, -2) @ (turned @ wanted[..., None]))[..., 0]
    return np.asarray((vectors @ (np.where(driven, along / np.where(driven, values, 1.0), 0.0))[..., None])[..., 0])


def _median(sizes: Array, counted: NDArray[np.bool_]) -> Array:
    """Medians (...) of sizes (..., W) that count; 0 where none does."""
    ordered = np.sort(np.where(counted, sizes, np.inf), axis=-1)
    count = counted.sum(axis=-1)
    pair = np.stack([np.maximum(count - 1, 0) // 2, np.minimum(count // 2, sizes.shape[-1] - 1)], axis=-1)
    if not sizes.shape[-1]:
        return np.zeros(count.shape)
    return np.where(count > 0, np.take_along_axis(ordered, pair, axis=-1).mean(axis=-1), 0.0)


def _between(times: Array, edges: Array, rows: Array) -> Array:
    """Rows (..., n) at times (...), by straight lines between the rows (F + 1, n) at the edges; held beyond."""
    after = np.clip(np.searchsorted(edges, times), 1, len(edges) - 1)
    share = np.clip((times - edges[after - 1]) / (edges[after] - edges[after - 1]), 0.0, 1.0)[..., None]
    return np.asarray(rows[after - 1] * (1 - share) + rows[after] * share)


def _means(values: Array, starts: NDArray[np.intp]) -> Array:
    """Means (..., B, n) of the rows of values (..., K, n) from each start to the next."""
    counts = np.diff(np.append(starts, values.shape[-2]))
    return np.asarray(np.add.reduceat(values, starts, axis=-2) / counts[:, None])


_BUNCHED, _TOGETHER = 1.2, 10  # factor of the mean period from the median, and samples that it is taken over; chosen


def usual_period(times: Iterable[Array]) -> float:
    """The usual time between samples of recordings, to the microsecond, s: the median, or the mean where stamps bunch.

    Messages that are stamped on arrival come in bunches: 47 ms, 3 ms, 47 ms ... at a period of 25 ms.
    """
    steps, spans, firsts = array("d"), array("d"), list[float]()  # of which there may be very many
    for stamps in times:
        firsts += stamps[:1].tolist()
        steps.frombytes(np.diff(stamps).tobytes())
        if len(stamps) > 2 * _TOGETHER:
            spans.frombytes(((stamps[_TOGETHER:] - stamps[:-_TOGETHER]) / _TOGETHER).tobytes())
    typical = float(np.median(np.frombuffer(steps), overwrite_input=True)) if steps else firsts[0]
    if spans:
        mean = float(np.median(np.frombuffer(spans), overwrite_input=True))
        typical = typical if 1 / _BUNCHED < mean / typical < _BUNCHED else mean
    return round(typical, 6) or typical


median_period = usual_period  # as plug-ins know it
