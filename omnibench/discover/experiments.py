"""Experiments that tell the members of a class of effects apart: the cheapest runs, chosen for this robot.

An experiment is said in words that a person can drive by, and as a config that can be simulated. It is chosen so that
it tells the effects apart in the least time: runs of one command after another are added, each time those that raise
the mean margins of all pairs most for their seconds, until every name would be sure; then runs that turned out to be
dispensable are taken away, and commands are exchanged for others that take less time. What results is a local optimum.

Further runs separate effects by the expected log odds of their names. Let I0 and s0 be information and scores of all
columns in the recorded runs: those of the base (matrix, and effects that are chosen beside the class) and those of the
class's members; and D the information of the further runs. If member i is right, with the values b of base and member
(0 elsewhere), the further runs add in expectation

    I = I0 + D,    s = s0 + D b.                                                                                    (1)

Once base and member j are fitted to all runs, their values are b_j, and member j has explained the chi-square Q_j
beyond the base. By Eq. (2) and (3) of evidence.py, and less ln t_j for t_j shapes, that gives the expected log odds of
i against j

    L_ij = ln B'_i - ln t_i - ln B'_j + ln t_j.                                                                     (2)

Noise of the further runs, the discrepancy that tempers the evidence by T = 1 + delta^2 N, and the matrix, each column
of which may have become larger by a small share (sd s) since the recorded runs, scatter them by

    var L_ij = (b_i - b_j)' D (b_i - b_j) / T + s^2 sum over k of ((b_i - b_j)' D m_k / T)^2,                       (3)

with m_k column k of the matrix in its place among all columns, and 0 elsewhere.

A name is sure with a weight of SURE; if the class as a whole has the weight c, its share of the class is p = SURE / c
then. Of m members, name i has that share where against every other one

    L_ij >= ln(p / (1 - p)) + ln(m - 1).                                                                            (4)

The values b are not known exactly. They are drawn from their distribution given the recorded runs, with a normal prior
of mean 0 and a standard deviation of three times the plausible size: what the recorded runs leave open is not taken for
large. The margin of i against j in a draw is (L_ij - threshold) / sd, its standard deviation at least 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from omnibench.config import to_yaml
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.fit import Extended, Fit, at_runs, columns_of
from omnibench.discover.result import SURE, Experiment, ExperimentCommand, NamedEffect
from omnibench.discover.select import DISCREPANCY, tempered_evidence
from omnibench.discover.significance import Group
from omnibench.fit.trajectory_fit import Given, Whitened
from omnibench.report.numbers import listing
from omnibench.robot.calibration import matrix_rows
from omnibench.robot.corrections import motions_of
from omnibench.robot.effects.effect import Effect
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.signals import of_centre
from omnibench.simulate.commands import DrivableCommands, Shapes, TimedCommand, Variation, is_within
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.robot_simulator import run_as_designed
from omnibench.words import plural

Counts = NDArray[np.intp]
LONGEST = 3600.0  # s of an experiment: nobody drives longer to settle a name (chosen)
_SURE = 0.95  # chance that the right name is sure; two standard deviations give 0.977, uncertain sizes take from it
_BATCHES = (2, 4, 8)  # runs of a command that are added at once, each command twice at least: their scatter shows
_PREPARING = 30.0  # s by which a further command must shorten the driving: it has to be prepared, too (chosen)
_ROUNDS = 3  # of exchanges: the third changes nothing in omni3
_KEPT = 15  # best commands of each pair of effects: of the others none is chosen in omni3 or the studies' flower


@dataclass(frozen=True, eq=False)
class Choice:
    """Chosen runs.

    counts (C,): of each candidate. chance: that the right name is sure. chance_recorded: the same after as long of the
    recorded commands. sure (m, m): pairs that are told apart.
    """

    counts: Counts
    chance: float
    chance_recorded: float
    sure: NDArray[np.bool_]


def choose_runs(separation: Separation, information: Array, seconds: Array, recorded: float) -> Choice:
    """The cheapest runs that tell all members apart, or as many pairs of them as can be told.

    information (C, p, p): of one run of each candidate. seconds (C,): that it takes. recorded: s that a recorded run
    takes.
    """
    # Indices of the candidates that alone raise the margin of some pair most for their seconds
    few = _BATCHES[1]
    gains = separation.prospect(few * information).mean_margins - separation.prospect(0 * information[:1]).mean_margins
    per_second = (gains / seconds[:, None, None]).reshape(len(seconds), -1)
    best = np.argsort(-per_second, axis=0)[:_KEPT]
    kept = np.unique(best[:, per_second.max(axis=0) > 0])
    problem = _Problem(separation, information[kept], seconds[kept])
    counts = problem.greedy()
    sure = problem.sure(problem.prospect(counts))
    counts = problem.pruned(counts, sure)
    for _ in range(_ROUNDS):
        counts = problem.exchanged(counts, sure)
    every = np.zeros(len(seconds), dtype=np.intp)
    every[kept] = counts
    as_many = float(every @ seconds) / recorded
    again = separation.prospect(as_many * separation.recorded_mean)
    return Choice(every, problem.prospect(counts).chance(sure), again.chance(sure), sure)


class _Problem:
    """Candidates with their information (C, p, p) and seconds (C,)."""

    def __init__(self, separation: Separation, information: Array, seconds: Array) -> None:
        self._separation, self._information, self._seconds = separation, information, seconds

    def prospect(self, counts: Counts) -> Prospect:
        """The prospect after counts (..., C) runs."""
        return self._separation.prospect(np.tensordot(counts, self._information, 1))

    def cost(self, counts: Counts) -> Array:
        """Seconds (...) of counts (..., C) runs, with preparing their commands."""
        of_each: Array = counts @ self._seconds + _PREPARING * (counts > 0).sum(axis=-1)
        return of_each

    def sure(self, prospect: Prospect) -> NDArray[np.bool_]:
        """Pairs (..., m, m) that are told apart whichever of the two is right."""
        chances = prospect.chances
        both: NDArray[np.bool_] = np.minimum(chances, np.swapaxes(chances, -1, -2)) >= _SURE
        return both

    def greedy(self) -> Counts:
        """Counts with runs added until all pairs are told apart, no run helps, or the time is over."""
        counts: Counts = np.zeros(len(self._seconds), dtype=np.intp)
        for _ in range(int(LONGEST)):
            now = self.prospect(counts)
            if self.sure(now).all():
                break
            # Counts (n, C) with a batch of runs more of one candidate
            each = np.eye(len(counts), dtype=np.intp)
            larger = np.concatenate([counts + batch * each for batch in _BATCHES])
            taken = self.cost(larger) - self.cost(counts)
            inside = larger @ self._seconds <= LONGEST
            gains = (self.prospect(larger).mean_margins - now.mean_margins).sum(axis=(-2, -1)) / taken
            gains[~inside] = 0
            best = int(gains.argmax())
            if gains[best] * LONGEST < 0.5:
                break
            counts = larger[best]
        return counts

    def pruned(self, counts: Counts, wanted: NDArray[np.bool_]) -> Counts:
        """Counts without the runs that the wanted pairs can do without, the longest first."""
        while True:
            fewer = []
            for index in np.flatnonzero(counts):
                for left in (0, counts[index] - 1):
                    if left == 0 or left >= _BATCHES[0]:
                        fewer.append(counts.copy())
                        fewer[-1][index] = left
            cheapest = self._cheapest(np.array(fewer, dtype=np.intp).reshape(-1, len(counts)), wanted)
            if cheapest is None:
                return counts
            counts = cheapest

    def exchanged(self, counts: Counts, wanted: NDArray[np.bool_]) -> Counts:
        """Counts with each command exchanged for runs of another one where that takes less time."""
        each = np.eye(len(counts), dtype=np.intp)
        for index in np.flatnonzero(counts):
            without = counts.copy()
            without[index] = 0
            most = counts[index] + 3
            others = np.concatenate([without + number * each for number in range(1, most)])
            often_enough = ((others == 0) | (others >= _BATCHES[0])).all(axis=1)
            others = others[often_enough & (self.cost(others) < self.cost(counts) - 1)]
            cheapest = self._cheapest(others, wanted)
            counts = counts if cheapest is None else cheapest
        return counts

    def _cheapest(self, options: Counts, wanted: NDArray[np.bool_]) -> Counts | None:
        """The cheapest of some counts (n, C) that tell the wanted pairs apart; None if none of them does."""
        if not len(options):
            return None
        enough = (self.sure(self.prospect(options)) | ~wanted).all(axis=(-2, -1))
        return options[np.where(enough, self.cost(options), np.inf).argmin()] if enough.any() else None


_DRAWS = 8  # draws of each member's values: half and twice as many change the minutes of omni3's plan by under 10 %
_PLAUSIBLE = 3.0  # times the plausible size: a larger effect is not to be expected (tests/studies/hidden/sets.py)
# s: radii change by so much with temperature, pressure and load within a day (chosen). A change by 0.3 % of all radii
# leaves the names of a small flower right, one by 1 % makes a class of them again.
_CHANGE = 0.002
_MOST_SHARE = 0.99  # share of a class's weight at which its member counts as settled; the class may be no surer
_RIDGE = 1e-9  # ridge of columns of unit length: values that no run determines stay at 0


@dataclass(frozen=True, eq=False)
class Members:
    """The members of a class, m of them, among p columns.

    base: columns that are fitted in any case. columns: those of each member. tries: shapes that were tried of each.
    prior (p,): inverse variances of the columns' values before any run. changes (p, M): standard deviations of the
    values between the recorded and further runs, one column for each independent cause.
    """

    base: tuple[int, ...]
    columns: tuple[tuple[int, ...], ...]
    tries: Array
    prior: Array
    changes: Array

    @staticmethod
    def of(matrix: Array, others: Sequence[Group], groups: Sequence[Group]) -> Members:
        """Members whose columns follow those of a matrix (3, M) and of other effects, in turn."""
        base = matrix.size + sum(len(group.parameters) for group in others)
        firsts = base + np.cumsum([0, *(len(group.parameters) for group in groups)])
        sizes = [each.largest for group in groups for each in group.parameters]
        prior = np.concatenate([np.zeros(base), 1 / np.square(_PLAUSIBLE * np.array(sizes))])
        columns = tuple(tuple(range(first, last)) for first, last in pairwise(firsts))
        changes = np.zeros((firsts[-1], matrix.shape[1]))
        for signal, values in enumerate(matrix.T):
            changes[signal : matrix.size : matrix.shape[1], signal] = _CHANGE * values  # elements row by row
        tries = np.array([float(group.tries) for group in groups])
        return Members(tuple(range(base)), columns, tries, prior, changes)


@dataclass(frozen=True, eq=False)
class Prospect:
    """Prospect of the names after further runs.

    margins (..., m, m, S): of i against j in S draws, infinite for i = j.
    """

    margins: Array

    @property
    def mean_margins(self) -> Array:
        """Margins (..., m, m), means over the draws, each counted up to what is wanted at most."""
        return np.minimum(self.margins, WANTED).mean(axis=-1)

    @property
    def chances(self) -> Array:
        """Chances (..., m, m) that i is sure against j, where i is right."""
        return norm.cdf(self.margins).mean(axis=-1)

    def chance(self, against: NDArray[np.bool_]) -> float:
        """Chance that the right name is sure, for the member that is hardest to tell.

        against (m, m): pairs that count.
        """
        margins = np.where(against[..., None], self.margins, np.inf)
        return float(norm.cdf(margins.min(axis=-2)).mean(axis=-1).min())


WANTED = 2.0  # standard deviations of Eq. (3) by which a name shall be sure: 97.7 of 100 experiments are as good


class Separation:
    """Expected log odds between the members of a class after further runs.

    recorded: columns of the recorded runs, with the members' effects put back into the residuals. weight: of the class.
    """

    def __init__(self, recorded: Whitened, members: Members, weight: float = 1.0) -> None:
        self.members = members
        self._information = recorded.information
        self.recorded_mean = recorded.information / len(recorded.scores)  # information (p, p) of a recorded run
        self._scores = recorded.scores.sum(axis=0)
        share = min(SURE / weight, _MOST_SHARE)
        self._threshold = math.log(share / (1 - share)) + math.log(len(members.columns) - 1)  # Eq. (4)

    @cached_property
    def _values(self) -> Array:
        """Draws (p, m * S) of the values of base and each member, by the recorded runs and the prior."""
        rng = np.random.default_rng(0)
        parts = []
        for columns in self.members.columns:
            index = [*self.members.base, *columns]
            information = self._information[np.ix_(index, index)] + np.diag(self.members.prior[index])
            roots = Given(information, self._scores[None, index], np.diag(information)).roots(range(len(index)))
            drawn = rng.standard_normal((roots.shape[1], _DRAWS // 2))
            values = np.zeros((len(self._scores), _DRAWS))
            mean = roots @ (roots.T @ self._scores[index])
            values[index] = mean[:, None] + roots @ np.hstack([drawn, -drawn])
            parts.append(values)
        return np.hstack(parts)

    def prospect(self, further: Array) -> Prospect:
        """The prospect after further runs of information (..., p, p)."""
        count = len(self.members.columns)
        values = self._values
        information, scores = self._information + further, self._scores[:, None] + further @ values  # Eq. (1)
        explained, fitted = self._fitted(information, scores)
        shape = (*further.shape[:-2], count, count, _DRAWS)  # j, i, draw
        rank = np.array([float(len(columns)) for columns in self.members.columns])[:, None, None]
        chi_square = explained.reshape(shape)
        tempered = 1 + DISCREPANCY**2 * np.maximum((chi_square - rank).max(axis=-3), 0.0)  # Eq. (3) of evidence.py
        evidence = tempered_evidence(chi_square / tempered[..., None, :, :], rank, 0.0)
        evidence = evidence - np.log(self.members.tries)[:, None, None]
        own = np.arange(count)
        odds = evidence[..., own, own, :][..., None, :, :] - evidence  # Eq. (2); j, i, draw
        fitted = fitted.reshape(*further.shape[:-2], count, len(self._scores), count, _DRAWS)
        apart = np.moveaxis(fitted[..., own, :, own, :], 0, -2)[..., None, :, :, :] - fitted
        flat = apart.reshape(*apart.shape[:-2], -1)
        weighed, over = further[..., None, :, :] @ flat, tempered[..., None, :, :]
        scatter = np.maximum((flat * weighed).sum(axis=-2), 0.0).reshape(shape)
        changed = np.square(self.members.changes.T @ weighed).sum(axis=-2).reshape(shape)
        deviation = np.sqrt(scatter / over + changed / np.square(over))  # Eq. (3)
        margins = (odds - self._threshold) / np.maximum(deviation, 1.0)
        margins[..., own, own, :] = np.inf
        return Prospect(np.swapaxes(margins, -3, -2))

    def _fitted(self, information: Array, scores: Array) -> tuple[Array, Array]:
        """Chi-square (..., m, n) that each member explains beyond the base, and its values (..., m, p, n).

        information (..., p, p), scores (..., p, n).
        """
        base, size = list(self.members.base), scores.shape[-2]
        later = [index for columns in self.members.columns for index in columns]
        sides = np.concatenate([information[..., base, :][..., later], scores[..., base, :]], axis=-1)
        solved = _solve(information[..., base, :][..., base], sides)
        of_columns, of_scores = solved[..., : len(later)], solved[..., len(later) :]
        across = information[..., later, :][..., base]
        beyond = information[..., later, :][..., later] - across @ of_columns
        rest = scores[..., later, :] - across @ of_scores
        explained, fitted, first = [], [], 0
        for columns in self.members.columns:
            own = slice(first, first + len(columns))
            first = own.stop
            values = _solve(beyond[..., own, own], rest[..., own, :])
            explained.append((rest[..., own, :] * values).sum(axis=-2))
            all_values = np.zeros((*scores.shape[:-2], size, scores.shape[-1]))
            all_values[..., list(columns), :] = values
            all_values[..., base, :] = of_scores - of_columns[..., own] @ values
            fitted.append(all_values)
        return np.stack(explained, axis=-2), np.stack(fitted, axis=-3)


def _solve(information: Array, scores: Array) -> Array:
    """Solution (..., n, k) of information (..., n, n) @ x = scores (..., n, k)."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 1e-300))[..., None]
    unit = information * scale * np.swapaxes(scale, -1, -2)
    solved: Array = scale * np.linalg.solve(unit + _RIDGE * np.eye(unit.shape[-1]), scale * scores)
    return solved


SESSION = "experiment"  # name of the session in which the new runs are driven
PLACING = 15.0  # s before a run, in which the robot is put into its place: a person walks a few metres (chosen)
RAMP = 0.3  # s at the start and the end of a run in which the speed changes: what small robots take (chosen)
# Shapes: finer steps change the minutes little, because runs of several kinds are combined (chosen).
_SHAPES = Shapes(lines=(1.0,), radii=(0.2, 0.5), turns=(180.0, 360.0), spins=(360.0, 1080.0), paces=(1.0, 0.5, 0.25))
_HEADINGS = (0.0, 90.0, 180.0, 270.0)  # deg, at the start, for effects that depend on the heading
_OFTEN = 0.99  # quantile of the speeds that the robot is taken to be able to drive: spikes lie beyond (chosen)
_LEAST_FLOOR = 1.0  # m, side of the floor that is free in any case: the robot stands somewhere (chosen)
_LEAST_STEERING = math.radians(10.0)  # rad: limit of the steering where a robot only drove straight on (chosen)
_TURNING = 1.0  # rad/s: at most, where the robot never turned as fast (chosen)
_WEAVE, _WEAVE_PERIOD = 0.3, 3.0  # rad/s and s, by which the rate of turn swings: gear play of a degree shows (chosen)
_COARSE = 0.05  # s: shorter samples tell the same of constant commands
_STAMPS = 80  # reference poses of a run that a fit uses, at most: see fit/trajectory_fit.py


@dataclass(frozen=True, eq=False)
class CandidateRun:
    """A run that could be driven. heading: of the robot at its start, deg; None where it does not matter."""

    timed: TimedCommand
    heading: float | None
    run: Trajectory

    @property
    def seconds(self) -> float:
        """Time that the run takes, s, with placing the robot."""
        return self.timed.duration + PLACING


def candidate_runs(fit: Fit, effects: Sequence[Effect]) -> tuple[CandidateRun, ...]:
    """Lines, arcs and turns on the spot at three paces, within the speeds and wheel rates of a fit's runs.

    effects: that are to be told apart; runs begin at several headings where one of these depends on it.
    """
    turned = any(effect.shows_in in ("heading", "place") for effect in effects)
    headings: Sequence[float | None] = _HEADINGS if turned else (None,)
    # Commands vary within a run: steering that turns shows what it does, and casters that swing round
    steering = any(effect.stage == "steering" or "steering_side" in effect.needs for effect in effects)
    casters = any("caster_rates" in effect.needs for effect in effects)
    commands = dict.fromkeys(
        _drivable(fit, Variation(weave=_WEAVE if steering else 0.0, period=_WEAVE_PERIOD, reversals=int(casters)))
    )
    return tuple(CandidateRun(timed, heading, _run(fit, timed, heading)) for timed in commands for heading in headings)


def _drivable(fit: Fit, variation: Variation) -> Iterator[TimedCommand]:
    """Commands within the limits of what was recorded, with their ramps and a variation."""
    robot = fit.model.robot
    motions = np.concatenate([motions_of(fit.model.matrix, run.times, run.signals) for run in fit.runs])
    twists = of_centre(robot, motions)
    speed = _mostly(np.hypot(twists[:, 0], twists[:, 1]))
    turning = _mostly(np.abs(twists[:, 2]))
    speed = max(speed, turning * robot.reach)  # a robot that only turned has wheels that drove that fast
    steering = [np.abs(run.steering).max(axis=1) for run in fit.runs if run.steering is not None and run.steering.size]
    side = max(float(np.ptp(run.poses[:, :2], axis=0).max()) for run in fit.runs)
    limit = max(_mostly(np.concatenate(steering)), _LEAST_STEERING) if steering else math.pi
    commands = DrivableCommands(
        robot,
        max_speed=speed,
        max_turn_rate=max(turning, min(_TURNING, speed / robot.reach)),
        max_wheel_rate=_mostly(np.concatenate([np.abs(run.rates).max(axis=1) for run in fit.runs])),
        steering_limit=limit,
        free=(max(side, _LEAST_FLOOR),) * 2,
        shapes=_SHAPES,
    )
    for timed in commands:
        if all(is_within(robot, extreme, limit) for extreme in variation.extremes(timed.command)):
            yield TimedCommand(timed.command, round(timed.duration + RAMP, 1), RAMP, variation)


def _mostly(values: Array) -> float:
    return float(np.quantile(values, _OFTEN))


def _run(fit: Fit, timed: TimedCommand, heading: float | None) -> Trajectory:
    """The run as the robot's design has it, with what was recorded of the fit's runs."""
    period = fit.model.sample_period
    assert period is not None
    between = float(np.median(np.concatenate([np.diff(run.pose_times) for run in fit.runs])))
    periods = (max(period, _COARSE), max(min(between, timed.duration / 4), timed.duration / _STAMPS))
    run = run_as_designed(OdometryModel.of_design(fit.model.robot, "arc"), timed, periods, timed.command.name)
    first = fit.runs[0]
    poses = run.poses.copy()
    if heading is not None:
        poses[0, 2] = math.radians(heading)
    return replace(
        run,
        poses=poses,
        session=None if first.session is None else SESSION,
        started_at=None if first.started_at is None else 0.0,
        angles=None if first.angles is None else np.cumsum(run.rates * periods[0], axis=0),
    )


_WAYS = {0: "ahead", 90: "left", 180: "backward", 270: "right"}  # directions of travel, deg
_SHORTEST_POSES = 0.02  # s between the reference poses that are simulated: denser ones take long and tell little more


def description_of(
    names: Sequence[str], runs: int, minutes: float, choice: Choice, inseparable: Sequence[tuple[str, str]]
) -> str:
    """How much to drive, and what it tells, in a few sentences."""
    hour = f"within {LONGEST / 60:.0f} minutes"
    if not runs:
        return f"Nothing that this robot can drive {hour} surely tells {listing(list(names), last='from')}."
    from_first = {first: [second for one, second in inseparable if one == first] for first, _ in inseparable}
    pairs = "; nor ".join(f"{first} from {listing(others, last='or')}" for first, others in from_first.items())
    alike = f" Nothing that it can drive {hour} surely tells {pairs}." if pairs else ""
    settled = "the right name" if not inseparable else "the right name, as far as it can be told,"
    return (
        f"Drive {plural(runs, 'run')}, {minutes:.1f} minutes with {PLACING:.0f} s before each to place the robot. On "
        f"both recordings together, discover then gives {settled} a weight of 95 % or more in "
        f"{_cases(choice.chance)}; after {minutes:.1f} more minutes of the commands that were recorded, in "
        f"{_cases(choice.chance_recorded)}.{alike}"
    )


def plan_config(
    dataset: Dataset,
    fit: Fit,
    effects: Sequence[NamedEffect],
    effect: NamedEffect,
    chosen: Sequence[tuple[CandidateRun, int]],
) -> str:
    """The experiment as a config for ``omnibench simulate``, with the effects that were found as its truth."""
    between = float(np.median(np.concatenate([np.diff(run.pose_times) for run in dataset.split("train")])))
    variation = chosen[0][0].timed.variation
    steering = [candidate.run.steering for candidate, _ in chosen if candidate.run.steering is not None]
    angles = [abs(float(angle)) for of_run in steering for angle in of_run.ravel()]
    config = FlowerConfig.model_validate(
        {
            "robot": dataset.robot.model_dump() | {"name": dataset.robot.name or "robot"},
            "sample_period": dataset.sample_period,
            "pose_period": max(between, dataset.sample_period, _SHORTEST_POSES),
            "commands": {
                "listed": [
                    {
                        "speed": candidate.timed.command.speed,
                        "direction_deg": round(math.degrees(candidate.timed.command.direction), 6),
                        "turn_rate": round(candidate.timed.command.turn_rate, 4),
                        "duration": candidate.timed.duration,
                        "repetitions": count,
                        "heading_deg": candidate.heading,
                    }
                    for candidate, count in chosen
                ],
                "ramp": RAMP,
            }
            | ({} if variation.is_none else {"variation": variation}),
            "steering_limit_deg": min(math.degrees(max(angles)) + 1, 180.0) if angles else None,
            "truth": {
                "matrix": matrix_rows(fit.model.matrix),
                "effects": [
                    {"name": each.name, "parameters": {value.name: value.value for value in each.parameters}}
                    for each in effects
                    if each.stage != "actuator"
                ],
            },
            "noise": fit.noise.noise.model_dump(),
            "train": {"seed": 1, "distance": 1.0},
        }
    )
    members = ", ".join((effect.name, *effect.confusable_with))
    return to_yaml(
        {
            "name": f"{dataset.name}_experiment",
            "description": f"Tells {members} apart; simulated with the first.",
            "datasets": {"experiment": {"simulate": config.model_dump(mode="json", exclude_defaults=True)}},
        }
    )


def _in_words(candidate: CandidateRun) -> str:
    """A run in words: where to, how fast, and how it turns."""
    command = candidate.timed.command
    end = "" if candidate.heading is None else f", from a heading of {candidate.heading:.0f}°"
    variation = candidate.timed.variation
    if variation.weave:
        end += f", weaving by {variation.weave:g} rad/s every {variation.period:g} s"
    if variation.reversals:
        end += ", turning back halfway"
    side = "left" if command.turn_rate > 0 else "right"
    if not command.speed:
        return f"turning {side} on the spot at {abs(command.turn_rate):.3g} rad/s{end}"
    degrees = round(math.degrees(command.direction)) % 360
    beside = f"{degrees}° left of ahead" if degrees < 180 else f"{360 - degrees}° right of ahead"
    way = f"{_WAYS.get(degrees, beside)} at {command.speed:.3g} m/s"
    if not command.turn_rate:
        return f"{way}, straight{end}"
    return f"{way}, curving {side} (radius {command.speed / abs(command.turn_rate):.2g} m){end}"


def _cases(chance: float) -> str:
    return f"{min(round(100 * chance), 99)} of 100 cases"


def experiments_for(
    dataset: Dataset, effects: Sequence[NamedEffect], models: Sequence[tuple[float, Extended]]
) -> tuple[Experiment, ...]:
    """One experiment for each effect that is confusable with others.

    models: that the recordings cannot tell apart, with their weights.
    """
    experiments = []
    groups = {group.name: group for _, model in reversed(models) for group in model.groups}
    for effect in effects:
        names = (effect.name, *effect.confusable_with)
        members = [groups[name] for name in names if name in groups]
        model = next((each for _, each in models if any(group.name == effect.name for group in each.groups)), None)
        if effect.confusable_with and effect.stage == "actuator":
            experiments.append(Experiment(names, _OF_MOTORS, ""))
        elif model is not None and len(members) > 1:
            experiments.append(_experiment(dataset, effects, effect, model, members))
    return tuple(experiments)


# Effects of the motors need no reference, and no choice of commands: any others show them (chosen).
_OF_MOTORS = "Drive at other speeds, from rest to rest: what motors make of their targets depends on nothing else."


def _experiment(
    dataset: Dataset, effects: Sequence[NamedEffect], effect: NamedEffect, model: Extended, members: Sequence[Group]
) -> Experiment:
    """The experiment that tells the members of a class apart, of which the effect is one that a model holds."""
    fit, others = model.fit, [group for group in model.groups if group.name != effect.name]
    groups, period = [*others, *members], fit.model.sample_period
    assert period is not None
    recorded = fit.whitened(columns_of(fit, groups), model.residuals_without_effects)
    separation = Separation(recorded, Members.of(fit.model.matrix, others, members), effect.class_weight)
    # The columns of runs that could be driven, by the model at their sample period
    candidates = candidate_runs(fit, [group.effect for group in members if group.effect is not None])
    seconds = np.array([candidate.seconds for candidate in candidates])
    coarse = replace(fit, model=replace(fit.model, sample_period=max(period, _COARSE)))
    driven = at_runs(coarse, [candidate.run for candidate in candidates])
    columns = columns_of(driven, groups)
    information = driven.whitened(columns, [np.zeros(of_run.shape[:2]) for of_run in columns]).information_of_runs
    of_recorded = float(np.mean([run.pose_times[-1] for run in fit.runs])) + PLACING
    choice = choose_runs(separation, information, seconds, of_recorded)
    chosen = [(candidates[index], int(choice.counts[index])) for index in np.flatnonzero(choice.counts)]
    runs, minutes = int(choice.counts.sum()), float(choice.counts @ seconds) / 60
    names = [group.name for group in members]
    pairs = zip(*np.nonzero(np.triu(~choice.sure)), strict=True)
    inseparable = tuple((names[first], names[second]) for first, second in pairs)
    return Experiment(
        separates=(effect.name, *effect.confusable_with),
        description=description_of(names, runs, minutes, choice, inseparable),
        config=plan_config(dataset, fit, effects, effect, chosen) if chosen else "",
        commands=tuple(
            ExperimentCommand(_in_words(candidate), count, candidate.timed.duration) for candidate, count in chosen
        ),
        runs=runs,
        minutes=minutes,
        chance=choice.chance if chosen else 0.0,
        chance_recorded=choice.chance_recorded if chosen else 0.0,
        inseparable=inseparable,
    )
