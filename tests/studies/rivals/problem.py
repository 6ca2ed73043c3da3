"""The regression that all rivals are given, and the answer that each gives back.

Rivals see what ``discover`` sees: a data set. They begin where it begins, at its plain matrix, its noise and its
candidates (slopes of the poses by the catalogue's effects in their textbook forms and by generic functions of the
covariates), so that only what each does with these is compared. Three forms of the regression, over the steps s_k of
residual and candidates from one reference pose to the next:

    strong      one row an interval and axis, s_k
    weak        sum of phi(t_k) s_k over windows, phi = (1 - u^2)^2, as pysindy's WeakPDELibrary integrates
    whitened    the residuals up to each pose, independent and of unit variance under the noise of repetitions

A rival that models a function of the covariates instead gets windows: mean covariates, and the twist that is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.discover.fit import Fit, at_runs, fit_matrix, paths_of
from omnibench.discover.paths import Paths, slopes_by
from omnibench.discover.screening import Screening, make_groups, screen
from omnibench.discover.significance import Group
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect
from omnibench.robot.kinematics import Array

Form = Literal["strong", "weak", "whitened"]
Changes = Callable[[Sequence[Trajectory]], list[Array]]
_ABSORBED = 0.02  # share of itself that an effect must keep beyond the matrix to be a candidate
_HARMONICS = (0.5, 2.0)  # of the wheel angle, beside eccentricity and 3 to 16 rollers
_WINDOW = 1.5  # s, of the weak form; chosen
_HALF = 0.5  # share of a function's signature that an effect must explain to be its name; chosen
_PART = 0.2  # share of what is explained that makes a term one of the answer; chosen


@dataclass(frozen=True, eq=False)
class Answer:
    """What a rival says.

    names: effects with its confidence, what explains most first. unnamed: what explains most is no effect. covariates:
    on which the missing part depends. values: of the first name's parameters. changes: by how much (K, 3) the poses of
    runs differ from the plain matrix's. alike: names that it cannot tell from the first.
    """

    names: tuple[tuple[str, float], ...]
    unnamed: bool
    covariates: frozenset[str]
    values: Mapping[str, float]
    changes: Changes
    alike: frozenset[str] = frozenset()


def nothing(runs: Sequence[Trajectory]) -> list[Array]:
    """Changes of the poses where nothing was found."""
    return [np.zeros((len(run.pose_times) - 1, 3)) for run in runs]


NOTHING = Answer((), False, frozenset(), {}, nothing)


@dataclass(frozen=True, eq=False)
class Regression:
    """Rows of one form beyond the matrix: columns (n, p), target (n,) of unit noise, run and stamp (n,) of each row.

    of_matrix (9, p + 1): the matrix elements that columns and target take up.
    """

    columns: Array
    target: Array
    run: NDArray[np.intp]
    stamp: NDArray[np.intp]
    of_matrix: Array

    @cached_property
    def products(self) -> Array:
        """Products (p + 1, p + 1) of columns and target."""
        return self.products_of(np.ones(len(self.target), dtype=bool))

    def products_of(self, rows: NDArray[np.bool_]) -> Array:
        """The products over some rows."""
        chosen = np.column_stack([self.columns[rows], self.target[rows]])
        return chosen.T @ chosen

    def blocks(self, count: int, rng: np.random.Generator) -> Array:
        """Products (count, p + 1, p + 1) over blocks of whole runs at random."""
        block = rng.permutation(np.arange(self.run.max() + 1) % count)[self.run]
        return np.array([self.products_of(block == number) for number in range(count)])


def solved(products: Array, index: Sequence[int]) -> tuple[Array, float]:
    """Least squares of some columns from products (p + 1, p + 1): values (k,), and the squares that they explain."""
    rows = list(index)
    inner = products[np.ix_(rows, rows)]
    values = np.linalg.lstsq(inner + 1e-9 * np.diag(np.diag(inner)), products[rows, -1], rcond=1e-10)[0]
    return values, float(values @ products[rows, -1])


def held_out_squares(products: Array, index: Sequence[int], values: Array) -> float:
    """Squares that values (k,) of some columns leave, over rows with these products."""
    rows = list(index)
    explained = 2 * values @ products[rows, -1] - values @ products[np.ix_(rows, rows)] @ values
    return float(products[-1, -1] - explained)


@dataclass(frozen=True, eq=False)
class Windows:
    """Parts of runs between reference poses. run, first, last (n,): the run, and its poses at both ends; seconds (n,).

    covariates (n, c), and names of these by what they are of. of_sample (F,): the window of each sample.
    """

    run: NDArray[np.intp]
    first: NDArray[np.intp]
    last: NDArray[np.intp]
    seconds: Array
    covariates: Array
    labels: tuple[str, ...]
    of_sample: NDArray[np.intp]
    paths: Paths

    def response(self, twists: Array) -> list[Array]:
        """Changes (K, 3) of each run's poses by twists (n, 3) of the windows."""
        changed = self.paths.summed(self.paths.changes(twists[self.of_sample])[:, :, None])[..., 0]
        return [changed[part] for part in self.paths.parts]


COVARIATE_OF = {
    "vx": "command", "vy": "command", "w": "command", "ax": "acceleration", "ay": "acceleration", "aw": "acceleration",
    "elapsed": "elapsed time", "travelled": "elapsed time", "session": "order of runs", "cos_heading": "heading",
    "sin_heading": "heading", "x": "place", "y": "place", "rate": "wheel rate", "cos": "wheel angle",
    "sin": "wheel angle",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Problem:
    """A data set, the plain matrix's fit to its training runs, and the candidates against the residuals."""

    dataset: Dataset
    plain: Fit

    @cached_property
    def screening(self) -> Screening:
        return screen(self.plain, self.plain.nuisance_free_residuals, make_groups(self.plain, ()))

    @cached_property
    def library(self) -> tuple[Group, ...]:
        """Candidates; ``index`` counts the columns of a regression."""
        groups, given = self.screening.groups, self.screening.beyond_matrix
        chosen = [group for group in groups.effects if given.share_left(group.index) > _ABSORBED]
        chosen += [
            group
            for group in groups.bases
            if group.basis is not None
            and (group.tries == 1 or group.name == "command" or group.basis.shapes.get("harmonic") in _HARMONICS)
        ]
        return tuple(group for group in chosen if group.index)

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """The library with the columns of each candidate counted in a regression's columns."""
        ends = np.cumsum([0, *(len(group.index) for group in self.library)])
        return tuple(
            replace(group, index=tuple(range(int(low), int(high))))
            for group, low, high in zip(self.library, ends, ends[1:], strict=False)
        )

    @cached_property
    def _regressions(self) -> dict[Form, Regression]:
        return {}

    def regression(self, form: Form = "whitened") -> Regression:
        """The rows of a form, computed once."""
        if form not in self._regressions:
            self._regressions[form] = self._rows(form)
        return self._regressions[form]

    def _rows(self, form: Form) -> Regression:
        matrix = list(self.screening.groups.matrix.index)
        wanted = [*matrix, *(column for group in self.library for column in group.index)]
        rows, runs, stamps = [], [], []
        if form == "whitened":
            data = self.screening.data
            for number, (columns, left) in enumerate(zip(data.columns, data.residuals, strict=True)):
                rows.append(np.column_stack([columns[:, wanted], left]))
                runs.append(np.full(len(left), number))
                stamps.append(np.repeat(np.flatnonzero(self.plain.masks[number]), 3)[: len(left)])
        else:
            residuals = self.plain.nuisance_free_residuals
            for part, steps in self.screening.groups.columns.blocks():
                for number, of_run in enumerate(steps, part.start):
                    change = np.diff(residuals[number], axis=0, prepend=0.0)
                    both = np.concatenate([of_run[..., wanted], change[..., None]], axis=2).astype(float)
                    summing = _windows_of(self.plain.stamps[number]) if form == "weak" else np.eye(len(both))
                    rows.append(np.einsum("jk,kac->jac", summing, both))
                    runs.append(np.full(len(summing), number))
                    stamps.append(np.abs(summing).argmax(axis=1))
            every = np.concatenate(rows)
            spread = 1.4826 * np.median(np.abs(every[..., -1]), axis=0)  # robust deviations along the axes
            rows = [(of_run / spread[:, None]).reshape(-1, len(wanted) + 1) for of_run in rows]
            runs, stamps = [np.repeat(of_run, 3) for of_run in runs], [np.repeat(of_run, 3) for of_run in stamps]
        every, elements = np.concatenate(rows), len(matrix)
        of_matrix = np.linalg.lstsq(every[:, :elements], every[:, elements:], rcond=1e-10)[0]
        beyond = every[:, elements:] - every[:, :elements] @ of_matrix
        return Regression(beyond[:, :-1], beyond[:, -1], np.concatenate(runs), np.concatenate(stamps), of_matrix)

    def linear_answer(self, regression: Regression, support: Sequence[int], confidence: Mapping[str, float]) -> Answer:
        """The answer of a rival that chose columns. confidence: of each effect's name."""
        if not len(support):
            return NOTHING
        values, whole = solved(regression.products, support)
        by_key: dict[tuple[bool, str], list[int]] = {}
        for group in self.groups:
            within = sorted(set(group.index) & set(support))
            if within:
                by_key.setdefault((group.effect is not None, group.name), []).extend(within)
        # What the rest of the columns cannot explain without those of an effect or a covariate
        shares = {
            key: 1 - solved(regression.products, [each for each in support if each not in columns])[1] / whole
            if len(columns) < len(support)
            else 1.0
            for key, columns in by_key.items()
        }
        order = sorted(shares, key=lambda key: -shares[key])
        parts = [key for key in order if shares[key] >= _PART * max(shares.values())]
        names = tuple((name, confidence.get(name, 0.0)) for is_effect, name in parts if is_effect)
        coefficients = dict(zip(support, values, strict=True))
        used = [(number, group) for number, group in enumerate(self.groups) if set(group.index) & set(support)]
        numbers: dict[str, float] = {}
        for _, group in used:
            if names and group.name == names[0][0] and group.effect is not None and not numbers:
                of_group = [coefficients.get(column, 0.0) for column in group.index]
                numbers = dict(zip((each.name for each in group.parameters), of_group, strict=True))
                numbers |= dict(group.shapes)
        elements = regression.of_matrix[:, -1] - regression.of_matrix[:, list(support)] @ values

        def changes(runs: Sequence[Trajectory]) -> list[Array]:
            sizes = [np.array([coefficients.get(column, 0.0) for column in group.index]) for _, group in used]
            of_terms = self._changes(runs, [self.library[number] for number, _ in used], sizes)
            jacobians = at_runs(self.plain, runs).matrix_jacobian()
            return [change + jacobian @ elements for change, jacobian in zip(of_terms, jacobians, strict=True)]

        covariates = frozenset(self._shown_in(key) for key in parts)
        return Answer(names, not parts[0][0], covariates, numbers, changes)

    @staticmethod
    def _shown_in(key: tuple[bool, str]) -> str:
        """The covariate of an effect, or of generic functions, which are called by theirs."""
        return effects.create(key[1]).shows_in if key[0] else key[1]

    def _changes(self, runs: Sequence[Trajectory], groups: Sequence[Group], sizes: Sequence[Array]) -> list[Array]:
        paths = paths_of(at_runs(self.plain, runs))
        total = np.zeros((len(paths.poses), 3))
        for group, values in zip(groups, sizes, strict=True):
            effect = group.effect
            names = [each.name for each in group.parameters]
            shapes = dict(group.shapes)
            if effect is None and group.name == "command":  # the basis itself knows the training runs' commands only
                assert group.basis is not None
                effect, shapes = effects.create(group.basis.term), dict(group.basis.shapes)
                names = [each.name for each in effect.parameters(paths.robot) if not each.choices]
            if effect is not None:
                assert isinstance(effect, MotionEffect | ReferenceEffect)
                slopes = slopes_by(paths, effect, names, dict.fromkeys(names, 0.0) | shapes)
            else:
                assert group.basis is not None
                assert group.basis.columns is not None
                slopes = group.basis.columns(paths)
            total += slopes @ values
        return [total[part] for part in paths.parts]

    def windows(self, runs: Sequence[Trajectory] | None, seconds: float) -> Windows:
        """Windows of about so many seconds of the training runs (None) or of others."""
        fit = self.plain if runs is None else at_runs(self.plain, runs)
        paths = paths_of(fit)
        signals, poses = paths.signals, paths.middle
        named = dict(zip(("vx", "vy", "w"), signals.twists.T, strict=True))
        named |= dict(zip(("ax", "ay", "aw"), signals.accelerations.T, strict=True))
        named |= {"elapsed": signals.elapsed, "travelled": signals.travelled, "x": poses[:, 0], "y": poses[:, 1]}
        named |= {"cos_heading": np.cos(poses[:, 2]), "sin_heading": np.sin(poses[:, 2])}
        if signals.session_time is not None:
            named["session"] = signals.session_time
        for wheel, name in enumerate(paths.robot.wheel_names):
            named[f"rate_{name}"] = signals.rates[:, wheel]
            if signals.wheel_angles is not None:
                angle = signals.wheel_angles[:, wheel]
                named |= {f"cos_{name}": np.cos(angle), f"sin_{name}": np.sin(angle)}
        found: list[tuple[int, int, int, float]] = []
        of_sample = np.empty(len(paths.owner), dtype=np.intp)
        for run, stamps in enumerate(fit.stamps):
            count = max(1, round(float(stamps[-1]) / seconds))
            ends = np.unique(np.abs(stamps[:, None] - stamps[-1] * np.arange(1, count + 1) / count).argmin(axis=0))
            samples = paths.owner == run
            of_sample[samples] = len(found) + stamps[ends[:-1]].searchsorted(signals.elapsed[samples])
            for first, last in zip([-1, *ends[:-1]], ends, strict=True):
                found.append((run, int(first), int(last), float(stamps[last] - (stamps[first] if first >= 0 else 0))))
        weights = np.bincount(of_sample, signals.durations, len(found))
        means = [np.bincount(of_sample, values * signals.durations, len(found)) / weights for values in named.values()]
        run_of, first_of, last_of, lengths = (np.array(each) for each in zip(*found, strict=True))
        labels = tuple(named)
        return Windows(run_of, first_of, last_of, lengths, np.column_stack(means), labels, of_sample, paths)

    def missing_twists(self, windows: Windows) -> Array:
        """The twist (n, 3) in the robot's frame that the plain matrix lacks in windows of the training runs."""
        twists = np.empty((len(windows.run), 3))
        for row, (run, first, last) in enumerate(zip(windows.run, windows.first, windows.last, strict=True)):
            poses, residuals = self.plain.poses[run], self.plain.residuals[run]
            before, error = (self.plain.runs[run].start, np.zeros(3)) if first < 0 else (poses[first], residuals[first])
            change, way, middle = residuals[last] - error, poses[last] - before, (poses[last, 2] + before[2]) / 2
            # Without the part that the error of the heading at the window's start makes of the way
            moved = complex(*change[:2]) - 1j * error[2] * complex(*way[:2])
            in_body = moved * np.exp(-1j * middle)
            twists[row] = np.array([in_body.real, in_body.imag, change[2]]) / windows.seconds[row]
        return twists

    def function_answer(
        self, twists_of: Callable[[Windows], Array], seconds: float, covariates: frozenset[str], sure: float
    ) -> Answer:
        """The answer of a rival that models the missing twist. sure: that anything is missing, 0 to 1.

        Its name is the effect that explains most of its function's signature beyond the matrix, with that share times
        ``sure`` as the confidence; where that is less than half, it has no name.
        """
        training = self.windows(None, seconds)
        whitened = self.plain.whitened([change[..., None] for change in training.response(twists_of(training))])
        regression, data = self.regression(), self.screening.data
        matrix = np.concatenate([columns[:, list(self.screening.groups.matrix.index)] for columns in data.columns])
        made = np.concatenate([columns[:, 0] for columns in whitened.columns])
        of_matrix = np.linalg.lstsq(matrix, np.column_stack([made, np.concatenate(data.residuals)]), rcond=1e-10)[0]
        made = made - matrix @ of_matrix[:, 0]
        whole = float(made @ made)
        if whole == 0:
            return NOTHING
        products = np.vstack([regression.products[:-1], np.append(made @ regression.columns, whole)])
        products[:, -1] = products[-1]
        named = [(solved(products, group.index), group) for group in self.groups if group.effect is not None]
        (numbers, explained), best = max(named, key=lambda pair: pair[0][1])
        share = explained / whole
        elements = of_matrix[:, 1] - of_matrix[:, 0]

        def changes(runs: Sequence[Trajectory]) -> list[Array]:
            windows = self.windows(runs, seconds)
            jacobians = at_runs(self.plain, runs).matrix_jacobian()
            pairs = zip(windows.response(twists_of(windows)), jacobians, strict=True)
            return [change + jacobian @ elements for change, jacobian in pairs]

        if share < _HALF:
            return Answer((), sure >= 0.5, covariates, {}, changes)
        values = dict(zip((each.name for each in best.parameters), numbers, strict=True)) | dict(best.shapes)
        return Answer(((best.name, share * sure),), False, covariates, values, changes)


def _windows_of(stamps: Array) -> Array:
    """Test functions (J, K) of the weak form over the intervals before K stamps, each of unit white noise."""
    middles = stamps - np.diff(stamps, prepend=0.0) / 2
    half = min(_WINDOW, float(stamps[-1])) / 2
    centres = np.arange(half, stamps[-1] - half + 1e-9, half) if stamps[-1] > 2 * half else np.array([half])
    functions = np.maximum(0.0, 1 - ((middles - centres[:, None]) / half) ** 2) ** 2
    ends = np.diff(functions, axis=1, prepend=0.0, append=0.0)
    return functions / np.linalg.norm(ends, axis=1, keepdims=True)


def make_problem(dataset: Dataset, without: frozenset[str] = frozenset()) -> Problem:
    """The problem of a data set without the training runs of some commands."""
    runs = [run for run in dataset.trajectories if run.split != "train" or run.command not in without]
    fewer = make_dataset(dataset.name, dataset.robot, dataset.sample_period, runs, simulated=dataset.simulated)
    start = dataset.robot.inverse_kinematic_matrix
    return Problem(fewer, fit_matrix(usable_runs(fewer.split("train")), dataset.robot, dataset.sample_period, start))


def commands_of_kinds(dataset: Dataset) -> list[frozenset[str]]:
    """The commands of each kind of motion: standing, slow or fast, by straight, left or right turns."""
    means: dict[str, Array] = {}
    for run in dataset.split("train"):
        if run.command is not None:
            means.setdefault(run.command, dataset.robot.inverse_kinematic_matrix @ run.signals.mean(axis=0))
    speeds = {name: float(np.hypot(*mean[:2])) for name, mean in means.items()}
    turns = {name: float(mean[2]) * dataset.robot.reach for name, mean in means.items()}
    largest = max(max(speeds.values()), max(map(abs, turns.values())))
    driven = [speed for speed in speeds.values() if speed > 0.1 * largest]
    middle = (min(driven) + max(driven)) / 2 if driven and max(driven) > 1.5 * min(driven) else 0.1 * largest
    kinds: dict[tuple[int, int], set[str]] = {}
    for name in means:
        turning = int(np.sign(turns[name])) if abs(turns[name]) > 0.1 * largest else 0
        kinds.setdefault((int(speeds[name] > 0.1 * largest) + int(speeds[name] > middle), turning), set()).add(name)
    return [frozenset(kinds[kind]) for kind in sorted(kinds)]
