"""Discovery on recordings of real robots: train on one kind of path or session, judge four models on another.

    python tests/studies/real_discovery.py --out real.jsonl [--only omni3] [--table]

Each row trains on some runs of a robot and judges on others: kinds of path, sessions, directions, turns and halves are
left out in turn. Four models are judged by the mean over the judged runs of Eq. (6):

    plain       calibrate with every effect off, the lost rate too
    matrix      discover's plain.yaml
    default     calibrate as it comes
    extended    discover's model.yaml

A row is a line of JSON in the file of results with the digest of omnibench's code, added as it comes: run again with
the same file and code, the study goes on where it was. Failures are rows with their reasons. A long drive is judged in
windows of 10 s.

Intervals are of the mean over the judged runs of Eq. (6) of ``extended`` less 1.05 times that of another model, by
Student's t; together they hold with 95 %: each is at the level 1 - 0.05 / R of R rows (Bonferroni). A row is worse
beyond chance if its interval is above 0. Ratios are averaged geometrically, over the rows of a robot and then over
robots; what was chosen across robots is shown with each robot left out.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from sys import path as import_path

import numpy as np
import yaml
from scipy.stats import t as student_t

ROOT = Path(__file__).resolve().parents[2]
import_path[:0] = [str(ROOT / "tests")]

from corelli import corelli_dataset  # noqa: E402
from real_recordings import OPTIODOM, RECORDINGS, ROBOTINO  # noqa: E402
from results_file import ResultsFile  # noqa: E402

from omnibench.config import Model  # noqa: E402
from omnibench.data.dataset import Dataset, Trajectory, make_dataset  # noqa: E402
from omnibench.discover.discover import discover_effects  # noqa: E402
from omnibench.errors import OmnibenchError  # noqa: E402
from omnibench.fit.calibrate import calibrate  # noqa: E402
from omnibench.fit.evaluate import final_errors  # noqa: E402
from omnibench.fit.motion_windows import windows_of  # noqa: E402
from omnibench.processes import one_thread  # noqa: E402
from omnibench.registry import load_plugin_file  # noqa: E402
from omnibench.robot.calibration import Calibration  # noqa: E402
from omnibench.slam.import_dataset import import_dataset  # noqa: E402

OTHERS = ("plain", "matrix", "default")  # models that the extended one is compared with
MODELS = (*OTHERS, "extended")
LEVEL = 0.05  # probability that any of the intervals is wrong
WORSE = 1.05  # ratio of Eq. (6) from which on a row is worse
WINDOW = 10.0  # s, in which drives are judged
_FEW = 8  # runs that are left out at least: sessions of fewer go together with the next of their kind
_HALF_OF_CORELLI = 57.0  # s
_SCALE = 0.4  # rad of DART's steering for a command of 1, as ``omnibench check`` says

Chooses = Callable[[Trajectory], bool]


class Row(Model):
    """One way to train and to judge. errors: final errors of the judged runs by each model, m, m, rad.

    terms: effects of the extended model, "name parameter=value". seconds: processor time of discover and of both
    calibrations.
    """

    robot: str
    what: str
    train: str
    judge: str
    code: str
    runs: tuple[int, int] = (0, 0)
    verdict: str = ""
    names: tuple[str, ...] = ()
    terms: tuple[str, ...] = ()
    errors: dict[str, tuple[tuple[float, float, float], ...]] = {}
    seconds: tuple[float, float] = (0.0, 0.0)
    failure: str = ""

    @property
    def key(self) -> str:
        return f"{self.robot}: {self.train} -> {self.judge}"

    def costs(self, model: str) -> np.ndarray:
        """Eq. (6) of each judged run by a model."""
        return np.linalg.norm(np.array(self.errors[model]), axis=1)

    def millimetres(self, model: str) -> float:
        """Mean distance of the judged runs' ends by a model from the reference."""
        return 1e3 * float(np.linalg.norm(np.array(self.errors[model])[:, :2], axis=1).mean())

    def degrees(self, model: str) -> float:
        """Mean heading error of the judged runs' ends."""
        return math.degrees(float(np.abs(np.array(self.errors[model])[:, 2]).mean()))

    def ratio(self, model: str, other: str) -> float:
        """Mean of Eq. (6) by a model over that by another."""
        return float(self.costs(model).mean() / self.costs(other).mean())


@dataclass(frozen=True)
class Way:
    """A way to train and to judge: which runs of a robot are for what. what: one of WHATS."""

    what: str
    train: str
    judge: str
    trains: Chooses
    judges: Chooses


def main() -> None:
    """Carry out the rows that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of results, one line of JSON a row")
    parser.add_argument("--only", nargs="+", default=list(ROBOTS), choices=list(ROBOTS), metavar="ROBOT")
    parser.add_argument("--what", nargs="+", default=list(WHATS), choices=list(WHATS), metavar="WHAT")
    parser.add_argument("--rows", default="", metavar="TEXT", help="only rows whose key holds it, as in 'circular -> '")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    arguments = parser.parse_args()
    file, code = ResultsFile(arguments.out, Row), code_digest()
    if not arguments.table:
        done = {row.key for row in file.results if row.code == code}
        for robot in arguments.only:
            recording = ROBOTS[robot]()
            for way in ways_of(robot, recording):
                key = f"{robot}: {way.train} -> {way.judge}"
                if way.what in arguments.what and arguments.rows in key and key not in done:
                    row = carry_out(recording, robot, way, code)
                    file.add(row)
                    print(f"{row.key}: {row.verdict or row.failure}, {sum(row.seconds):.0f} s", flush=True)
    newest = file.results[-1].code if arguments.table and file.results else code
    print_table([row for row in file.results if row.robot in arguments.only and row.code == newest])


def code_digest() -> str:
    """Digest of omnibench's source files."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "omnibench").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def carry_out(recording: Dataset, robot: str, way: Way, code: str) -> Row:
    """Calibrate and discover on the runs that train, and judge all models on the others."""
    trained, judged = split_by(recording, way)
    size = (len(trained), len(judged))
    row = Row(robot=robot, what=way.what, train=way.train, judge=way.judge, code=code, runs=size)
    errors: dict[str, tuple[tuple[float, float, float], ...]] = {}

    def judge(name: str, calibration: Calibration) -> None:
        errors[name] = tuple(map(tuple, final_errors(calibration.model, judged).tolist()))

    began = calibrated = time.process_time()
    try:
        with one_thread():
            dataset = make_dataset(robot, recording.robot, recording.sample_period, [*trained, *judged])
            judge("plain", calibrate(dataset, options={"lost_rate": 0}).calibration)
            judge("default", calibrate(dataset).calibration)
            calibrated = time.process_time()
            found = discover_effects(dataset)
            terms = tuple(terms_of(found.extended))
            names = tuple(
                f"{' or '.join((each.name, *each.confusable_with))} {each.weight:.2f}/{each.class_weight:.2f}"
                for each in found.effects
            )
            row = row.model_copy(update={"verdict": found.verdict, "names": names, "terms": terms})
            judge("matrix", found.plain)
            judge("extended", found.extended)
    except Exception as error:  # the study goes on, and the table says so
        expected = "" if isinstance(error, OmnibenchError) else "TRACEBACK "
        row = row.model_copy(update={"failure": f"{expected}{type(error).__name__}: {error}"})
    seconds = (time.process_time() - calibrated, calibrated - began)
    return row.model_copy(update={"errors": errors, "seconds": seconds})


def split_by(recording: Dataset, way: Way) -> tuple[list[Trajectory], list[Trajectory]]:
    """The runs that train and those that judge, long ones of these in windows."""
    trained = [replace(run, split="train") for run in recording.trajectories if way.trains(run)]
    judged = [replace(run, split="validation") for run in recording.trajectories if way.judges(run)]
    if way.what == "drive":
        judged = [window for run in judged for window in windows_of(run, max(1, int(run.end / WINDOW)))]
    return trained, judged


def terms_of(calibration: Calibration) -> Iterator[str]:
    """The effects of a calibration with their values."""
    for term in calibration.effects:
        values = " ".join(f"{name}={value:.3g}" for name, value in list(term.parameters.items())[:3])
        yield f"{term.name} {values}" + (" ..." if len(term.parameters) > 3 else "")


def worse_beyond_chance(row: Row, other: str, rows: int) -> bool:
    """True if the extended model is worse than WORSE times another by an interval that is one of so many."""
    differences = row.costs("extended") - WORSE * row.costs(other)
    count = len(differences)
    if count < 2:
        return False
    reach = student_t.ppf(1 - LEVEL / rows / 2, count - 1) * differences.std(ddof=1) / math.sqrt(count)
    return bool(differences.mean() > reach)


def print_table(rows: Sequence[Row]) -> None:
    """Print a line for each row, the means by robot and over robots, and with each robot left out."""
    judged = [row for row in rows if not row.failure]
    head = "".join(f"{model:>9}" for model in MODELS)
    print(f"{'':80}{'Eq. (6), m and rad':>36}   {'extended / others':24}   mm/deg of default, extended")
    print(f"{'robot: trained on -> judged on':60}{'runs':>8} {'verdict':11}{head}   {'plain  matrix  default':24}")
    for row in rows:
        print(f"{row.key:60}{row.runs[0]:>4}+{row.runs[1]:<3}", end=" ")
        if row.failure:
            costs = ", ".join(f"{model} {row.costs(model).mean():.4f}" for model in row.errors)
            print(f"failed: {row.failure}; {costs}")
            continue
        costs = "".join(f"{row.costs(model).mean():9.4f}" for model in MODELS)
        ratios = " ".join(f"{row.ratio('extended', other):7.3f}" for other in OTHERS)
        sizes = "  ".join(f"{row.millimetres(model):.1f}/{row.degrees(model):.2f}" for model in ("default", "extended"))
        worse = [other for other in OTHERS if worse_beyond_chance(row, other, len(judged))]
        words = f"WORSE than {', '.join(worse)}" if worse else ""
        print(f"{row.verdict:11}{costs}   {ratios}    {sizes}  {sum(row.seconds):.0f} s {words}")
        for kind, effects in (("named", row.names), ("terms", row.terms)):
            if effects:
                print(f"      {kind}: {', '.join(effects)}")
    if not judged:
        return
    robots = list(dict.fromkeys(row.robot for row in judged))
    of_robots = {
        robot: [
            geometric_mean(row.ratio("extended", other) for row in judged if row.robot == robot) for other in OTHERS
        ]
        for robot in robots
    }

    def line(name: str, count: int, ratios: Iterable[float]) -> str:
        return f"{name:10}{count:5}" + "".join(f"{ratio:9.3f}" for ratio in ratios)

    print("\nEq. (6) of extended over that of the others, geometric means; on the right all robots but one")
    print(f"{'':10}{'rows':>5}" + "".join(f"{other:>9}" for other in OTHERS))
    for robot in robots:
        left_out = [values for one, values in of_robots.items() if one != robot]
        count = sum(row.robot == robot for row in judged)
        print(line(robot, count, of_robots[robot]) + line("", 0, map(geometric_mean, zip(*left_out, strict=True)))[15:])
    print(line("robots", len(robots), map(geometric_mean, zip(*of_robots.values(), strict=True))))
    for what in dict.fromkeys(row.what for row in judged):
        of_what = [row for row in judged if row.what == what]
        means = (geometric_mean(row.ratio("extended", other) for row in of_what) for other in OTHERS)
        print(line(what, len(of_what), means))
    for other in OTHERS:
        above = sum(row.ratio("extended", other) > WORSE for row in judged)
        sure = sum(worse_beyond_chance(row, other, len(judged)) for row in judged)
        print(f"worse than {WORSE} of {other}: {above} of {len(judged)} rows, {sure} of them beyond chance")
    print(f"{len(rows) - len(judged)} rows failed; {sum(sum(row.seconds) for row in judged):.0f} s")


def geometric_mean(values: Iterable[float]) -> float:
    """Geometric mean; NaN of none."""
    values = list(values)
    return math.exp(float(np.mean(np.log(values)))) if values else math.nan


def _optiodom(robot: str) -> Callable[[], Dataset]:
    return lambda: import_dataset("optiodom", OPTIODOM / robot)


def _robotino() -> Dataset:
    assert load_plugin_file(ROOT / "plugins" / "robotino.py") is None
    return import_dataset("robotino", ROBOTINO)


def _corelli() -> Dataset:
    """The drive in runs of 10 s, with the steering encoder's scale that check_exam/recordings.py found."""
    return corelli_dataset(window=WINDOW, steering_scale=0.564)


def _dart() -> Dataset:
    """Four drives of a car, with the steering's scale that ``omnibench check`` tells; its lag is left to be found."""
    columns = {
        "t": "vicon time", "rear": "vel encoder", "steer_front": "steering",
        "x": "vicon x", "y": "vicon y", "theta": "vicon yaw",
    }  # fmt: skip
    front = {"name": "front", "type": "steered", "driven": False, "radius": 0.0325, "x": 0.175, "y": 0}
    wheels = [{"name": "rear", "type": "fixed", "radius": 0.0325, "x": 0, "y": 0}, front]
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder) / "robot.yaml"
        robot.write_text(yaml.safe_dump({"name": "dart", "wheels": wheels}))
        for kind in ("free_driving", "steering"):
            for number, path in enumerate(sorted((RECORDINGS / "dart" / kind).glob("*.csv")), 1):
                (Path(folder) / f"{kind}{number}.csv").symlink_to(path)
        options = {"columns": columns, "wheel_unit": "m/s", "robot": str(robot), "steering_scale": _SCALE}
        return import_dataset("csv", Path(folder), options)


def ways_of(robot: str, recording: Dataset) -> Iterator[Way]:
    """All ways to train and to judge: kinds and sessions in turn, directions, turns, and halves of repetitions."""
    runs = sorted(recording.trajectories, key=lambda run: run.id)
    if robot == "dart":
        fast, slow = _group("free_driving"), _group("steering")
        for run in runs:
            yield Way("drive", f"all but {run.id}", run.id, _not(_group(run.id)), _group(run.id))
        yield from _both_ways("drive", "slow drives", "fast drives", slow, fast)
        return
    if robot == "corelli":
        early = _one_of({run.id for run in runs if (run.started_at or 0) < _HALF_OF_CORELLI})
        yield from _both_ways("half", "first half", "second half", early, _not(early))
        even = _one_of({run.id for run in runs if int(run.id.rsplit("#", 1)[1]) % 2 == 0})
        yield from _both_ways("half", "even windows", "odd windows", even, _not(even))
        return
    if robot == "robotino":
        even, ahead, left = _directions(lambda angle: angle % 10 == 0), _sector(-90, 90), _sector(0, 180)
        yield from _both_ways("half", "even directions", "odd directions", even, _not(even))
        yield from _both_ways("direction", "ahead", "back", ahead, _not(ahead))
        yield from _both_ways("direction", "to the left", "to the right", left, _not(left))
        return
    kinds = list(dict.fromkeys(run.id.split("_")[0] for run in runs))
    for kind in kinds:
        for other in kinds:
            if other != kind:
                yield Way("kind", kind, other, _group(kind), _group(other))
        if len(kinds) > 2:
            others = _not(_group(kind))
            yield Way("kind", f"all but {kind}", kind, others, _group(kind))
    for kind in kinds:
        of_kind = [run for run in runs if run.id.startswith(kind)]
        for one, two in (("_a0_", "_a90_"), ("_turn+", "_turn-")):
            if all(any(word in (run.command or "") for run in of_kind) for word in (one, two)):
                chosen = (_both(_group(kind), _has(word)) for word in (one, two))
                yield from _both_ways("direction", f"{kind}{one}", f"{kind}{two}", *chosen)
        counts, first = dict[str | None, int](), set[str]()
        for run in of_kind:
            counts[run.command] = counts.get(run.command, -1) + 1
            first |= {run.id} if counts[run.command] % 2 == 0 else set()
        half = _one_of(first)
        yield Way("half", f"{kind}, half", "its repetitions", half, _both(_group(kind), _not(half)))
    for kind in kinds:
        together: list[str] = []
        sessions = sorted({str(run.session) for run in runs if run.id.startswith(kind)}, key=_by_date)
        for number, session in enumerate(sessions, 1):
            together.append(session)
            if sum(run.session in together for run in runs) >= _FEW or number == len(sessions):
                left_out = _both(_group(kind), _session(*together))
                name = f"{kind} of {', '.join(together)}"
                yield Way("session", f"all but {name}", name, _not(left_out), left_out)
                together = []


def _by_date(session: str) -> str:
    """The session's time, of a name DDMMYYYYhhmm."""
    return session[4:8] + session[2:4] + session[:2] + session[8:]


def _both_ways(what: str, name: str, other: str, one: Chooses, two: Chooses) -> tuple[Way, Way]:
    """To train on one and judge the other, and the other way round."""
    return Way(what, name, other, one, two), Way(what, other, name, two, one)


def _group(name: str) -> Chooses:
    return lambda run: run.id.startswith(name)


def _has(part: str) -> Chooses:
    return lambda run: part in (run.command or "")


def _both(*chooses: Chooses) -> Chooses:
    return lambda run: all(each(run) for each in chooses)


def _not(chooses: Chooses) -> Chooses:
    return lambda run: not chooses(run)


def _one_of(ids: Collection[str]) -> Chooses:
    return lambda run: run.id in ids


def _session(*names: str) -> Chooses:
    return lambda run: run.session in names


def _directions(chooses: Callable[[int], bool]) -> Chooses:
    """Runs of the Robotino by their commanded direction, deg."""
    return lambda run: chooses(5 * int(run.id.rsplit("exp", 1)[1]))


def _sector(low: float, high: float) -> Chooses:
    return _directions(lambda angle: low <= angle % 360 < high or low <= angle % 360 - 360 < high)


WHATS = ("kind", "direction", "half", "drive", "session")
ROBOTS: dict[str, Callable[[], Dataset]] = {
    "omni3": _optiodom("omni3"),
    "omni4": _optiodom("omni4"),
    "diff": _optiodom("diff"),
    "tricyc": _optiodom("tricyc"),
    "robotino": _robotino,
    "corelli": _corelli,
    "dart": _dart,
}

if __name__ == "__main__":
    main()
