"""Discovery on recordings of real robots: train on one kind of path, judge plain and extended model on another.

    python tests/studies/real_discovery.py --out real.jsonl [--only omni3] [--no-unknown-term] [--table]

One line of JSON a row, added as it comes: run again with the same file, and it goes on where it was. With --table the
table is printed from what is there. A row says what was trained on and what was judged, the verdict, the names, and
means over the judged runs of the final error of the plain matrix -> the extended model.

Intervals are of the mean over the judged runs of Eq. (6) of the extended model less that of the plain matrix, by
Student's t; together they hold with 95 %, whatever the dependence of the rows on each other: each is at the level
1 - 0.05 / R of R rows (Bonferroni). A row is worse or better if its interval leaves out 0.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import t as student_t

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests")]

from corelli import corelli_dataset  # noqa: E402
from real_recordings import OPTIODOM, ROBOTINO  # noqa: E402
from results_file import ResultsFile  # noqa: E402

from omnibench.config import Model  # noqa: E402
from omnibench.data.dataset import Dataset, Trajectory, make_dataset  # noqa: E402
from omnibench.discover.discover import discover_effects  # noqa: E402
from omnibench.fit.evaluate import final_errors  # noqa: E402
from omnibench.processes import one_thread  # noqa: E402
from omnibench.registry import load_plugin_file  # noqa: E402
from omnibench.slam.import_dataset import import_dataset  # noqa: E402

LEVEL = 0.05  # probability that any of the intervals is wrong
Chooses = Callable[[Trajectory], bool]


class Row(Model):
    """One way to train and to judge. plain, extended: final errors of the judged runs, m, m, rad."""

    robot: str
    train: str
    judge: str
    runs: tuple[int, int] = (0, 0)
    verdict: str = ""
    names: tuple[str, ...] = ()
    plain: tuple[tuple[float, float, float], ...] = ()
    extended: tuple[tuple[float, float, float], ...] = ()
    seconds: float = 0.0
    failure: str = ""

    @property
    def key(self) -> str:
        return f"{self.robot}: {self.train} -> {self.judge}"

    @property
    def differences(self) -> np.ndarray:
        """Eq. (6) of each judged run by the extended model less that by the plain matrix."""
        plain, extended = (np.linalg.norm(np.array(errors), axis=1) for errors in (self.plain, self.extended))
        return extended - plain


@dataclass(frozen=True)
class Way:
    """A way to train and to judge: which runs of a robot are for what."""

    train: str
    judge: str
    trains: Chooses
    judges: Chooses


def main() -> None:
    """Carry out the rows that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of results, one line of JSON a row")
    parser.add_argument("--only", nargs="+", default=list(ROBOTS), choices=list(ROBOTS), metavar="ROBOT")
    parser.add_argument("--no-unknown-term", action="store_true", help="add no term without a name")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    arguments = parser.parse_args()
    file = ResultsFile(arguments.out, Row)
    if not arguments.table:
        done = {row.key for row in file.results}
        for row in _carried_out(arguments.only, done, unknown_term=not arguments.no_unknown_term):
            file.add(row)
            print(f"{row.key}: {row.verdict or row.failure}, {row.seconds:.0f} s", flush=True)
    print_table([row for row in file.results if row.robot in arguments.only])


def _carried_out(robots: Sequence[str], done: set[str], *, unknown_term: bool) -> Iterator[Row]:
    for robot in robots:
        ways = [way for way in WAYS[robot] if f"{robot}: {way.train} -> {way.judge}" not in done]
        if ways:
            recording = _numbered(ROBOTS[robot]())
            for way in ways:
                yield carry_out(recording, robot, way, unknown_term=unknown_term)


def _numbered(recording: Dataset) -> Dataset:
    """The recording with the runs of each command numbered 0, 1, 0, 1 ... in ``repetition``, in the order of time."""
    count: dict[str | None, int] = {}
    runs = []
    for run in sorted(recording.trajectories, key=lambda run: run.id):
        number = count[run.command] = count.get(run.command, -1) + 1
        runs.append(replace(run, repetition=number % 2))
    return replace(recording, trajectories=tuple(runs))


def carry_out(recording: Dataset, robot: str, way: Way, *, unknown_term: bool) -> Row:
    """Discover on the runs that train, and judge both models on the others."""
    trained = [replace(run, split="train") for run in recording.trajectories if way.trains(run)]
    judged = [replace(run, split="validation") for run in recording.trajectories if way.judges(run)]
    row = Row(robot=robot, train=way.train, judge=way.judge, runs=(len(trained), len(judged)))
    began = time.perf_counter()
    try:
        with one_thread():
            dataset = make_dataset(robot, recording.robot, recording.sample_period, [*trained, *judged])
            found = discover_effects(dataset, unknown_term=unknown_term)
            plain, extended = (
                tuple(map(tuple, final_errors(calibration.model, dataset.split("validation")).tolist()))
                for calibration in (found.plain, found.extended)
            )
    except Exception as error:  # the study goes on, and the table says so
        return row.model_copy(update={"failure": f"{type(error).__name__}: {error}"})
    names = tuple(f"{each.name} {each.weight:.2f}" for each in found.effects)
    return Row(
        **row.model_dump(exclude={"verdict", "names", "plain", "extended", "seconds"}),
        verdict=found.verdict,
        names=names,
        plain=plain,
        extended=extended,
        seconds=time.perf_counter() - began,
    )


def print_table(rows: Sequence[Row]) -> None:
    """Print a line for each row, then how many are better and worse, and the mean."""
    judged = [row for row in rows if not row.failure]
    print(f"{'robot: trained on -> judged on':58}{'runs':>8} {'verdict':11}{'position, m':>18}{'heading, deg':>15}"
          f"{'Eq. (6)':>18}  change of Eq. (6) with its interval")  # fmt: skip
    better, worse, means = 0, 0, []
    for row in rows:
        if row.failure:
            print(f"{row.key:58}{row.runs[0]:>4}+{row.runs[1]:<3} failed: {row.failure}")
            continue
        plain, extended = np.array(row.plain), np.array(row.extended)
        position = [float(np.hypot(each[:, 0], each[:, 1]).mean()) for each in (plain, extended)]
        heading = [math.degrees(float(np.abs(each[:, 2]).mean())) for each in (plain, extended)]
        cost = [float(np.linalg.norm(each, axis=1).mean()) for each in (plain, extended)]
        difference, reach = row.differences, _reach(row.differences, len(judged))
        mean = float(difference.mean())
        means.append(math.log(cost[1] / cost[0]))
        better, worse = better + (mean + reach < 0), worse + (mean - reach > 0)
        said = "better" if mean + reach < 0 else "WORSE" if mean - reach > 0 else ""
        print(f"{row.key:58}{row.runs[0]:>4}+{row.runs[1]:<3} {row.verdict:11}{position[0]:>8.4f} ->{position[1]:>7.4f}"
              f"{heading[0]:>7.2f} ->{heading[1]:>5.2f}{cost[0]:>8.4f} ->{cost[1]:>7.4f}"
              f"  {mean:+.4f} +- {reach:.4f} {said}")  # fmt: skip
        if row.names:
            print(f"    {', '.join(row.names)}")
    if judged:
        print(f"\n{len(judged)} rows: {better} better, {worse} worse by intervals that hold together with 95 %; Eq. (6)"
              f" of the extended model is {100 * (math.exp(np.mean(means)) - 1):+.1f} % in the geometric mean; "
              f"{sum(row.seconds for row in judged):.0f} s")  # fmt: skip


def _reach(differences: np.ndarray, rows: int) -> float:
    """Half-width of the interval of a mean of differences that is one of so many."""
    count = len(differences)
    if count < 2:
        return math.inf
    return float(student_t.ppf(1 - LEVEL / rows / 2, count - 1) * differences.std(ddof=1) / math.sqrt(count))


def _optiodom(robot: str) -> Callable[[], Dataset]:
    return lambda: import_dataset("optiodom", OPTIODOM / robot)


def _robotino() -> Dataset:
    assert load_plugin_file(ROOT / "plugins" / "robotino.py") is None
    return import_dataset("robotino", ROBOTINO)


def _corelli() -> Dataset:
    """The drive in runs of 10 s, with the steering encoder's scale that check_exam/recordings.py found."""
    return corelli_dataset(window=10, steering_scale=0.564)


def _group(name: str) -> Chooses:
    return lambda run: run.id.startswith(name)


def _has(part: str) -> Chooses:
    return lambda run: part in (run.command or "")


def _both(*chooses: Chooses) -> Chooses:
    return lambda run: all(each(run) for each in chooses)


def _not(chooses: Chooses) -> Chooses:
    return lambda run: not chooses(run)


def _session(*names: str) -> Chooses:
    return lambda run: run.session in names


def _direction(low: float, high: float) -> Chooses:
    """Runs of the Robotino whose commanded direction is from ``low`` to below ``high``, deg."""
    return lambda run: low <= _angle(run) % 360 < high or low <= _angle(run) % 360 - 360 < high


def _every_second_direction(rest: int) -> Chooses:
    return lambda run: _angle(run) % 10 == rest


def _angle(run: Trajectory) -> int:
    return 5 * int(run.id.rsplit("exp", 1)[1])


def _other_way(name: str, other: str, one: Chooses, two: Chooses) -> tuple[Way, Way]:
    """To train on one and judge the other, and the other way round."""
    return Way(name, other, one, two), Way(other, name, two, one)


def _half(name: str) -> Way:
    """Every second repetition of the commands of a kind of path, and the others."""
    first, others = _both(_group(name), lambda run: run.repetition == 0), lambda run: run.repetition == 1
    return Way(f"{name}, half", "its repetitions", first, _both(_group(name), others))


def _pairs(*names: str) -> Iterator[Way]:
    for name in names:
        for other in names:
            if name != other:
                yield Way(name, other, _group(name), _group(other))
    for name in names:
        yield _half(name)


def _within(name: str, part: str, other: str) -> tuple[Way, Way]:
    """Runs of a kind of path whose commands have one part, and those that have another."""
    one, two = (_both(_group(name), _has(word)) for word in (part, other))
    return _other_way(f"{name}{part}", f"{name}{other}", one, two)


_LATE = ("231220200453", "231220200502", "231220200510")  # of omni4, sessions of December

ROBOTS: dict[str, Callable[[], Dataset]] = {
    "omni3": _optiodom("omni3"),
    "omni4": _optiodom("omni4"),
    "diff": _optiodom("diff"),
    "tricyc": _optiodom("tricyc"),
    "robotino": _robotino,
    "corelli": _corelli,
}
WAYS: dict[str, tuple[Way, ...]] = {
    "omni3": (
        *_pairs("circular", "square"),
        *_within("circular", "_a0_", "_a90_"),
        *_within("circular", "_turn+", "_turn-"),
        *_within("square", "_a0_", "_a90_"),
    ),
    "omni4": (
        *_other_way("September", "December", _not(_session(*_LATE)), _session(*_LATE)),
        *_other_way("080920201547", "080920201911", _session("080920201547"), _session("080920201911")),
        *_within("circular", "_a0_", "_a90_"),
        _half("circular"),
    ),
    "diff": (*_pairs("circular", "square", "ivanjko"), *_within("circular", "_turn+", "_turn-")),
    "tricyc": tuple(_pairs("circular", "square")),
    "robotino": (
        *_other_way("even directions", "odd directions", *(_every_second_direction(rest) for rest in (0, 5))),
        *_other_way("ahead", "back", _direction(-90, 90), _direction(90, 270)),
        *_other_way("to the left", "to the right", _direction(0, 180), _direction(180, 360)),
    ),
    "corelli": _other_way(
        "first half", "second half", lambda run: (run.started_at or 0) < 57, lambda run: (run.started_at or 0) >= 57
    ),
}

if __name__ == "__main__":
    main()
