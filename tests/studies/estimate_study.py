"""Any calibrator on simulated robots of seven classes: its error on other paths, and whether its intervals hold.

    python tests/studies/estimate_study.py --out FOLDER --calibrator closed_form --calibrator posterior --sets 16
    python tests/studies/estimate_study.py --out FOLDER --calibrator 'posterior:{"lost_rate": 0}' --classes omni skid
    python tests/studies/estimate_study.py --out FOLDER --calibrator posterior --coverage --commands 3 5 8 --sets 1000

The simulation, its tolerances, effects and slip are those of simulated_robots.py, which shares no code with what fits.
Results are kept in FOLDER, one line of JSON a robot: run again, and it goes on where it was. The names of its files
hold a digest of the simulation, but none of the calibrators: take another folder, or --fresh, when these change.

**Errors.** A robot is trained on one or two kinds of path and judged on all others by Eq. (6) of Palacin et al. 2023:
the mean norm of the final poses' errors, m and rad alike, against final poses without slip. The table has, by class,
the ratio of the mean error to that of the truth's form (the same fit given the true effect, Form.by_path), with a 95 %
interval over robots (bootstrap), and to that of the true likelihood (Form.by_likelihood), which knows how much slips;
then the first ratio where the judged commands slip, too (not their runs), the geometric mean of the robots' ratios, and
the ratio by effect. Calibrators are compared with the first one, too, robot by robot.

**Coverage** (--coverage). All kinds of path are trained on, and the effects are those that posterior knows, none and a
lost rate, unless --effects names others. Slip is 0 in the mean, so the truth is the geometry, and with --sessions the
mean of all sessions. A share holds if its exact binomial 95 % interval (Clopper and Pearson, a set counting as one
trial), widened by Holm's rule over the rows of the table, meets 93 to 97 %. Elements that are 0 by design and in truth
do not count. Of physical parameters those are looked at that a calibration states and the simulation knows.

In a Python shell: ``for case in simulated_cases("omni", 16): case.dataset, case.judged, case.truth_error``.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binom

sys.path.insert(0, str(Path(__file__).parent))
import simulated_robots
from simulated_robots import CLASSES, EFFECTS, Case, simulated_case
from simulated_robots import simulated_cases as simulated_cases

from omnibench.errors import OmnibenchError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.processes import one_thread

Array = NDArray[np.float64]
Intervals = Mapping[str, tuple[float, float, float]]  # value, low and high by name

TRUTH, LIKELIHOOD = "truth's form", "true likelihood"
LEVEL, LEAST, MOST = 0.95, 0.93, 0.97
RESAMPLES = 4000
_NORMAL = 1.959964  # deviations of a 95 % interval
_ROUNDING = 1e-12  # m/rad and rad/rad: smaller elements are 0


def code_digest(path: Path) -> str:
    """Digest of a file's code, without its comments and docstrings."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # a text alone in a line does nothing
            node.body = [  # type: ignore[attr-defined]
                each for each in body if not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant))
            ]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


SIMULATION = code_digest(Path(simulated_robots.__file__))


@dataclass(frozen=True)
class Cell:
    """One cell of a table: a calibrator with its options as JSON, and robots of a class with their recordings."""

    base: str
    calibrator: str
    options: str
    commands: int
    repetitions: int
    sessions: int
    effects: tuple[str, ...]
    all_kinds: bool

    @property
    def label(self) -> str:
        """The calibrator in a table."""
        return self.calibrator + (f":{self.options}" if self.options else "")

    def case(self, seed: int) -> Case:
        """The robot of a seed."""
        return simulated_case(
            self.base,
            seed,
            commands=self.commands,
            repetitions=self.repetitions,
            sessions=self.sessions,
            effects=self.effects,
            all_kinds=self.all_kinds,
        )

    def path(self, folder: Path) -> Path:
        """The file of its results."""
        choices = json.dumps([asdict(self), SIMULATION])
        digest = hashlib.sha256(choices.encode()).hexdigest()[:8]
        return folder / f"{re.sub(r'[^a-z_]', '', self.calibrator)}-{self.base}-{self.commands}-{digest}.jsonl"


@dataclass(frozen=True)
class Row:
    """Result of a robot. errors, with_slip: by judged path; empty where there is no answer, then failure says why.

    elements, parameters: where the truth lies in each interval, -1 and 1 being its ends; None where none is stated.
    """

    seed: int
    effect: str
    size: float
    trained: str
    errors: tuple[float, ...]
    with_slip: tuple[float, ...]
    elements: dict[str, float | None]
    parameters: dict[str, float | None]
    seconds: float
    failure: str = ""


def judged(cell: Cell, seed: int, stated: Callable[[CalibrationRun], Intervals] | None = None) -> Row:
    """Fit a robot and compare with its truth; stated: gives the intervals of physical parameters."""
    case = cell.case(seed)
    known = (seed, case.effect.name, round(float(np.hypot(*case.effect.size)), 6), "+".join(case.trained))
    begin = time.perf_counter()
    elements: dict[str, float | None] = {}
    parameters: dict[str, float | None] = {}
    if cell.calibrator in (TRUTH, LIKELIHOOD):
        poses = case.ends(*(case.truth_fit if cell.calibrator == TRUTH else case.likelihood_fit))
    else:
        try:
            run = calibrate(case.dataset, cell.calibrator, options=json.loads(cell.options or "{}"))
        except OmnibenchError as error:
            return Row(*known, (), (), {}, {}, time.perf_counter() - begin, str(error))
        poses = np.array([path[-1] for path in run.calibration.model.poses([each.final_log for each in case.judged])])
        elements = places_of_truth(elements_of(case), stated_elements(run))
        parameters = places_of_truth(case.parameters, (stated or stated_parameters)(run))
        parameters = {name: place for name, place in parameters.items() if place is not None}
    errors, slipped = case.errors(poses).round(6).tolist(), case.errors(poses, with_slip=True).round(6).tolist()
    seconds = round(time.perf_counter() - begin, 3)
    return Row(*known, tuple(errors), tuple(slipped), elements, parameters, seconds)


def elements_of(case: Case) -> dict[str, float]:
    """The true elements of the matrix by their names, without those that are 0 by design and in truth."""
    matrix, design = case.matrix, case.base.robot.inverse_kinematic_matrix
    return {
        f"m{row + 1}{column + 1}": float(matrix[row, column])
        for row, column in np.ndindex(*matrix.shape)
        if max(abs(matrix[row, column]), abs(design[row, column])) > _ROUNDING
    }


def stated_elements(run: CalibrationRun) -> Intervals:
    """The elements of a calibration's matrix with their 95 % intervals, by name; none where none is stated."""
    matrix = run.calibration.matrix_array
    if run.uncertainty is not None:
        low, high = run.uncertainty.intervals.low, run.uncertainty.intervals.high
    elif run.calibration.covariance is not None:
        deviations = np.sqrt(np.diag(np.array(run.calibration.covariance)))[: matrix.size].reshape(matrix.shape)
        low, high = matrix - _NORMAL * deviations, matrix + _NORMAL * deviations
    else:
        return {}
    return {
        f"m{row + 1}{column + 1}": (float(matrix[row, column]), float(low[row, column]), float(high[row, column]))
        for row, column in np.ndindex(*matrix.shape)
    }


def stated_parameters(run: CalibrationRun) -> Intervals:
    """The physical parameters of a calibration that have a 95 % interval, by their names in DESIGN.md.

    Exchange this function where they are found elsewhere; ``judged`` takes another one.
    """
    stated: Iterable[Any] = run.parameters or getattr(run.uncertainty, "parameters", None) or ()
    ends = {each.name: (each.value, getattr(each, "low", None), getattr(each, "high", None)) for each in stated}
    return {
        name: (float(value), float(low), float(high))
        for name, (value, low, high) in ends.items()
        if low is not None and high is not None
    }


def places_of_truth(truth: Mapping[str, float], stated: Intervals) -> dict[str, float | None]:
    """Where true values lie in their intervals, -1 and 1 being the ends; None where there is none with a width."""
    places: dict[str, float | None] = {}
    for name, true in truth.items():
        value, low, high = stated.get(name, (np.nan,) * 3)
        error = true - value
        if name.startswith(("angle", "steering_zero", "mount_yaw")):
            error = float(np.angle(np.exp(1j * error)))
        reach = high - value if error > 0 else value - low
        places[name] = round(float(np.clip(error / reach, -1e3, 1e3)), 4) if reach > 0 else None
    return places


def rows_of(cell: Cell, folder: Path, sets: int, table_only: bool = False, fresh: bool = False) -> list[Row]:
    """The rows of the first seeds, from the cell's file, those that are missing added to it as they come."""
    path = cell.path(folder)
    written = "" if fresh or not path.exists() else path.read_text()
    whole = written[: written.rfind("\n") + 1]  # a line that was cut off is done again
    rows = {row.seed: row for row in (Row(**json.loads(line)) for line in whole.splitlines())}
    if not table_only:
        path.write_text(whole)
        with path.open("a") as file:
            for seed in range(sets):
                if seed not in rows:
                    rows[seed] = judged(cell, seed)
                    file.write(json.dumps(asdict(rows[seed])) + "\n")
                    file.flush()
    return [rows[seed] for seed in range(sets) if seed in rows]


@dataclass(frozen=True)
class Ratio:
    """Ratio of mean errors with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, errors: Array, truth: Array) -> Ratio:
        """By resampled robots (n,)."""
        rng, count = np.random.default_rng(0), len(errors)
        drawn = rng.integers(count, size=(RESAMPLES, count))
        low, high = np.quantile(errors[drawn].sum(axis=1) / truth[drawn].sum(axis=1), [0.025, 0.975])
        return cls(float(errors.mean() / truth.mean()), float(low), float(high))

    def __str__(self) -> str:
        return f"{self.value:5.2f} ({self.low:.2f} to {self.high:.2f})"


def error_table(results: Mapping[Cell, list[Row]]) -> Iterator[str]:
    """A line for every class and calibrator, then one for each calibrator over all classes."""
    yield (
        f"{'class':13s}{'calibrator':24s}sets  failed  1000 x error  {TRUTH}  likelihood   error / {TRUTH}    "
        "error / likelihood     commands slip  geometric  s"
    )
    ratios: dict[str, list[tuple[float, float]]] = {}
    for cell, rows in results.items():
        pairs = [(row, *both) for row, both in paired(cell, rows, results) if row.errors]
        if cell.calibrator in (TRUTH, LIKELIHOOD) or not pairs:
            continue
        means, slipped = (
            np.array([[np.mean(getattr(row, name)) for row in three] for three in pairs]).T
            for name in ("errors", "with_slip")
        )
        ratio, to_likelihood = Ratio.of(means[0], means[1]), Ratio.of(means[0], means[2])
        ratios.setdefault(cell.label, []).append((ratio.value, to_likelihood.value))
        own, truth, likelihood = 1000 * means.mean(axis=1)
        yield (
            f"{cell.base:13s}{cell.label:24s}{len(pairs):4d}  {len(rows) - len(pairs):6d}  {own:12.1f}  "
            f"{truth:12.1f}  {likelihood:10.1f}   {ratio!s:22s} {to_likelihood!s:22s} "
            f"{slipped[0].mean() / slipped[1].mean():13.2f}  {np.exp(np.log(means[0] / means[1]).mean()):9.2f}  "
            f"{np.mean([row.seconds for row in rows]):.1f}"
        )
    for label, of_classes in ratios.items():
        both = np.exp(np.log(of_classes).mean(axis=0))
        yield f"{label}, geometric mean of {len(of_classes)} classes: {both[0]:.2f} and {both[1]:.2f}"


def paired(cell: Cell, rows: Sequence[Row], results: Mapping[Cell, list[Row]]) -> Iterator[tuple[Row, tuple[Row, Row]]]:
    """Rows of a cell with those of the truth's form and of the true likelihood for the same robots."""
    by = {name: replace(cell, calibrator=name, options="") for name in (TRUTH, LIKELIHOOD)}
    of_truth, of_likelihood = ({row.seed: row for row in results.get(each, [])} for each in by.values())
    for row in rows:
        if row.seed in of_truth and row.seed in of_likelihood:
            yield row, (of_truth[row.seed], of_likelihood[row.seed])


def effect_table(results: Mapping[Cell, list[Row]]) -> Iterator[str]:
    """Mean error over that of the truth's form by effect, with the number of robots."""
    yield f"{'error / ' + TRUTH + ', by effect':37s}" + "".join(f"{effect:>13s}" for effect in EFFECTS)
    for cell, rows in results.items():
        if cell.calibrator in (TRUTH, LIKELIHOOD):
            continue
        words = []
        for effect in EFFECTS:
            pairs = [
                (np.mean(row.errors), np.mean(both[0].errors))
                for row, both in paired(cell, rows, results)
                if row.errors and row.effect == effect
            ]
            found, true = np.sum(pairs, axis=0) if pairs else (np.nan, np.nan)
            words.append(f"{found / true:7.2f} ({len(pairs):3d})")
        yield f"{cell.base:13s}{cell.label:24s}" + "".join(f"{word:>13s}" for word in words)


def comparison_table(results: Mapping[Cell, list[Row]]) -> Iterator[str]:
    """Mean error of every calibrator over that of the first one on the same robots, by class."""
    fitted = [cell for cell in results if cell.calibrator not in (TRUTH, LIKELIHOOD)]
    labels = list(dict.fromkeys(cell.label for cell in fitted))
    yield f"error / that of {labels[0]}"
    for label in labels[1:]:
        ratios = []
        for cell in fitted:
            if cell.label != label:
                continue
            first = replace(cell, calibrator=fitted[0].calibrator, options=fitted[0].options)
            of_first = {row.seed: np.mean(row.errors) for row in results[first] if row.errors}
            pairs = [
                (np.mean(row.errors), of_first[row.seed])
                for row in results[cell]
                if row.errors and row.seed in of_first
            ]
            if pairs:
                ratios.append(Ratio.of(*np.array(pairs).T))
                yield f"{cell.base:13s}{label:24s}{len(pairs):4d}  {ratios[-1]}"
        mean = np.exp(np.mean([np.log(ratio.value) for ratio in ratios])) if ratios else np.nan
        yield f"{label}, geometric mean of {len(ratios)} classes: {mean:.2f}"


@dataclass(frozen=True)
class Share:
    """A share of intervals that hold the truth, over sets (n,) of the set's own share: exact, a set as one trial."""

    hits: int
    sets: int

    @classmethod
    def of(cls, shares: Sequence[float]) -> Share:
        """The share of some sets."""
        return cls(round(float(np.sum(shares))), len(shares))

    def interval(self, level: float = LEVEL) -> tuple[float, float]:
        """Clopper and Pearson's."""
        tail = (1 - level) / 2
        low = beta.ppf(tail, self.hits, self.sets - self.hits + 1) if self.hits else 0.0
        high = beta.isf(tail, self.hits + 1, self.sets - self.hits) if self.hits < self.sets else 1.0
        return float(low), float(high)

    @property
    def p_value(self) -> float:
        """The largest error probability whose interval still meets LEAST to MOST: 1 if the share lies there."""
        below = 2 * binom.cdf(self.hits, self.sets, LEAST)
        above = 2 * binom.sf(self.hits - 1, self.sets, MOST)
        return float(min(1.0, below if self.hits / self.sets < LEAST else above))


def holm(p_values: Sequence[float], alpha: float = 1 - LEVEL) -> list[bool]:
    """True for hypotheses that stand (Holm, Scandinavian J. Statistics 6:65, 1979)."""
    stands = [True] * len(p_values)
    for rank, index in enumerate(np.argsort(p_values)):
        if p_values[index] * (len(p_values) - rank) > alpha:
            break
        stands[index] = False
    return stands


def coverage_table(results: Mapping[Cell, list[Row]], of: str) -> Iterator[str]:
    """A line for every cell. of: elements or parameters."""
    lines: list[tuple[str, Share | None, str, int]] = []
    for cell, rows in results.items():
        stated: list[dict[str, float | None]] = [getattr(row, of) for row in rows]
        places = [{name: abs(place) for name, place in each.items() if place is not None} for each in stated]
        own = [each for each in places if each]
        head = (
            f"{cell.base:13s}{cell.label:24s}{cell.commands:8d}{cell.sessions:9d}{len(own):6d}{len(rows) - len(own):8d}"
        )
        if not own:
            lines.append((head, None, "none stated", 0))
            continue
        share = Share.of([float(np.mean([place <= 1 for place in each.values()])) for each in own])
        names = sorted({name for each in own for name in each})
        by_name = {name: float(np.mean([each[name] <= 1 for each in own if name in each])) for name in names}
        worst = min(by_name, key=lambda name: by_name[name])
        without = sum(place is None for each in stated for place in each.values())
        lines.append((head, share, f"{worst} {100 * by_name[worst]:.1f}", without))
    yield (
        f"{of:13s}{'calibrator':24s}commands sessions  sets without  held, % (exact 95 %)     verdict    "
        "least               not stated"
    )
    verdicts = iter(holm([share.p_value for _, share, _, _ in lines if share]))
    for head, each, worst, without in lines:
        if each is None:
            yield f"{head}  {worst}"
            continue
        low, high = each.interval()
        held = f"{100 * each.hits / each.sets:5.1f} ({100 * low:.1f} to {100 * high:.1f})"
        yield f"{head}  {held:24s} {'holds' if next(verdicts) else 'FAILS':9s}  {worst:20s}{without:10d}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit the robots that are missing, then print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--calibrator", action="append", help="NAME[:options as JSON]; may be given several times")
    parser.add_argument("--classes", nargs="+", choices=CLASSES, default=CLASSES)
    parser.add_argument("--sets", type=int, default=16, help="robots a class")
    parser.add_argument("--commands", type=int, nargs="+", default=[12], help="of the training runs")
    parser.add_argument("--repetitions", type=int, help="runs of a command, in each session; default 3, of coverage 2")
    parser.add_argument("--sessions", type=int, nargs="+", default=[1], help="more than one differ")
    parser.add_argument("--effects", nargs="+", choices=EFFECTS, help="that are drawn from; default: see above")
    parser.add_argument("--coverage", action="store_true", help="judge intervals, not errors")
    parser.add_argument("--table", action="store_true", help="only print what is there")
    parser.add_argument("--fresh", action="store_true", help="fit the calibrators' robots anew")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    effects = tuple(given.effects or (EFFECTS[:2] if given.coverage else EFFECTS))
    chosen = [each.partition(":")[::2] for each in given.calibrator or ["posterior"]]
    if not given.coverage:
        chosen = [(TRUTH, ""), (LIKELIHOOD, ""), *chosen]
    repetitions = given.repetitions or (2 if given.coverage else 3)
    cells = [
        Cell(base, name, options, commands, repetitions, sessions, effects, given.coverage)
        for base, commands, sessions, (name, options) in product(given.classes, given.commands, given.sessions, chosen)
    ]
    results: dict[Cell, list[Row]] = {}
    with one_thread(), ExitStack() as stack:
        if given.coverage:  # the verdict on held-out runs takes most of the time, and no interval hangs on it
            stack.enter_context(patch("omnibench.fit.calibrate.verdict_on", lambda *_: None))
        for cell in cells:
            fresh = given.fresh and cell.calibrator not in (TRUTH, LIKELIHOOD)
            results[cell] = rows_of(cell, given.out, given.sets, given.table, fresh)
    tables: list[Iterable[str]] = [error_table(results), effect_table(results), comparison_table(results)]
    if given.coverage:
        tables = [coverage_table(results, "elements"), coverage_table(results, "parameters")]
    print("\n\n".join("\n".join(table) for table in tables))


if __name__ == "__main__":
    main()
