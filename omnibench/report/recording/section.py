"""A recording as it is shown: contents, paths, wheel rates, runs step by step.

Beside it reference poses by SLAM, with their errors against the truth. The document that templates/player.js plays:
poses, wheel rates and scans of a run, rounded.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.stored import drawn_runs
from omnibench.data.true_poses import TruePath
from omnibench.report import blocks
from omnibench.report.figures import is_placed, joined, line
from omnibench.report.numbers import NOTHING, count, fixed, significant
from omnibench.report.recording import recording_figures
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import plot
from omnibench.robot.kinematics import Array, compose, interpolated, placed, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.slam.slam_dataset import SlamAccuracy, SlamResult, SlamSummary, run_errors, slam_accuracy
from omnibench.words import kind_of_data, plural

_FRAMES = 200  # frames drawn of a run (chosen: steps of the slider that can be told apart)
_SCANS = 30  # scans drawn of a run (chosen: keeps the file small)
_RAYS = 180  # rays drawn of a scan (chosen: keeps the file small)
_MARGIN = 0.4  # m around everything that is drawn
_SEEN = blocks.LegendItem("scan", "this moment's scan", "#d97706")
_SEEN_BEFORE = blocks.LegendItem("map", "earlier scans", recording_figures.SCANS_ITEM.colour)


def player(
    dataset: Dataset,
    runs: Mapping[str, Trajectory],
    odometry: OdometryModel,
    truth: Mapping[str, TruePath],
    outlines: Mapping[str, Sequence[Array]],
) -> blocks.Player:
    """A player for these runs, chosen by the menu's names and moved through with a slider.

    outlines: for each run the walls of the floor plan in the frame of its reference poses, each (n, 2), m.
    """
    return blocks.Player(
        {name: _run(dataset, run, odometry, truth.get(run.id), outlines.get(run.id, ())) for name, run in runs.items()},
        "The robot from above with what it saw, its path so far and its wheel rates, at the time of the slider",
        "Between reference poses the robot is drawn on a straight line; wheel rates are means over the 100 ms before. "
        "With the slider in focus the arrow keys go step by step.",
    )


def _run(
    dataset: Dataset, run: Trajectory, odometry: OdometryModel, truth: TruePath | None, outlines: Sequence[Array]
) -> dict[str, Any]:
    times = np.linspace(0.0, run.end, min(_FRAMES, max(2, round(run.end / 0.02) + 1)))
    poses = recording_figures.poses_at(run, times)
    (driven,) = odometry.poses([run.log(times)])
    scans = list(_played_scans(dataset, run))
    told = [values for values in (run.rates, run.targets) if values is not None]
    rates = [recording_figures.means_before(run, values, times) for values in told]
    # Left, bottom, right and top of the picture, m; the farthest 0.5 % of the points on each side are cut off
    points = np.vstack(
        [poses[:, :2], driven[:, :2], *outlines, *(np.reshape(scan["points"], (-1, 2)) for scan in scans)]
    )
    low, high = np.quantile(points, 0.005, axis=0) - _MARGIN, np.quantile(points, 0.995, axis=0) + _MARGIN
    steered = dataset.robot.drive.steered
    shown = [recording_figures.REFERENCE_ITEM, recording_figures.ODOMETRY_ITEM]
    shown += [recording_figures.TRUTH_ITEM] if truth is not None else []
    shown += [recording_figures.PLAN_ITEM] if outlines else []
    shown += [_SEEN, _SEEN_BEFORE] if scans else []
    return {
        "times": _rounded(times),
        "poses": _rounded(poses, 4),
        "odometry": _rounded(driven[:, :2]),
        "truth": None if truth is None else _rounded(placed(run.start, truth.at(times))),
        "rates": _rounded(rates[0]),
        "targets": None if run.targets is None else _rounded(rates[1]),
        "rate_limit": round(1.05 * max(float(np.abs(rates).max()), 1e-3), 3),
        "scans": scans,
        "plan": [_rounded(outline) for outline in outlines],
        "window": _rounded(np.concatenate([low, high])),
        "rated": dataset.robot.wheel_names,
        "steering": None if run.steering is None else _rounded(interpolated(times, run.times, run.steering)),
        # Radius and place, m, direction of rolling, rad, index of the angle that steers it, of the wheels drawn.
        "wheels": [
            {
                "radius": wheel.radius,
                "at": _rounded(np.array(wheel.position), 6),
                "rolling": wheel.rolling,
                "steered": steered.index(wheel.name) if wheel.has_steering else None,
            }
            for wheel in dataset.robot.wheels
            if is_placed(wheel)
        ],
        "radius": max(math.hypot(wheel.reach, wheel.radius) for wheel in dataset.robot.wheels),
        "key": [{"name": item.key, "label": item.label, "colour": item.colour} for item in shown],
    }


def _played_scans(dataset: Dataset, run: Trajectory) -> Iterator[dict[str, Any]]:
    """Some scans of a run: stamp, scanner position, and points as x, y, x, y, ..., m."""
    if dataset.scans is None or run.id not in dataset.scans.trajectories:
        return
    scanner, scans = dataset.scans.scanner, dataset.scans.of(run.id)
    for scan in recording_figures.evenly(len(scans.times), _SCANS):
        stamp = scans.times[scan]
        origin = compose(recording_figures.poses_at(run, stamp), scanner.mount.pose)
        points = recording_figures.scan_points(run, scanner, scans, int(scan), -(-scanner.rays // _RAYS))
        yield {"t": round(float(stamp), 4), "from": _rounded(origin[:2]), "points": _rounded(points.ravel())}


def _rounded(values: Array, decimals: int = 3) -> Any:
    return np.round(values, decimals).tolist()


class ReferencePosesResult(Result):
    """Reference poses by SLAM: how certain they are, and how far from recorded and from true ones.

    result: of ``slam``. poses, report: the data set and the page that were written.
    """

    def __init__(self, result: SlamResult, poses: Path | None = None, report: Path | None = None) -> None:
        self.result, self.poses, self.report = result, poses, report
        self.warnings = result.summary.warnings

    def tables(self) -> Sequence[blocks.Table]:
        summary = self.result.summary
        stated = {name.replace("_deviation", ""): each for name, each in summary if "_deviation_" in name}
        columns = {"stated deviation at a run's end": stated}
        if summary.recorded is not None:
            columns["distance from the recorded reference"] = summary.recorded.model_dump()
        note = f"{plural(summary.runs, 'run')}, {plural(summary.scans, 'scan')}; {summary.matched_mean:.1%} of the "
        note += f"points matched (worst scan {summary.matched_min:.0%})"
        title = f"{summary.dataset}, {kind_of_data(summary.simulated)}: reference poses from the scans"
        errors = [] if summary.accuracy is None else [error_table(summary.accuracy)]
        return [field_table(title, columns, note), *errors]

    def remarks(self) -> Sequence[Remark]:
        written = {"report": self.report, plural(self.result.summary.runs, "trajectory"): self.poses}
        return [Remark(f"{what}: {file}") for what, file in written.items() if file is not None]

    def next_step(self) -> NextStep:
        poses = f"{plural(self.result.summary.scans, 'scan')} gave poses"
        if self.poses is None:
            return NextStep(f"{poses}, which are written nowhere", "write a data set with them with -o DATASET")
        command = ("omnibench", "calibrate", self.poses, "-o", "calibration.yaml")
        return NextStep(poses, "calibrate with them", command)

    def document(self) -> blocks.Document:
        result = self.result
        return recording_document(result.dataset, truth=result.truth, accuracy=result.summary.accuracy)

    def json(self) -> SlamSummary:
        return self.result.summary


class SimulatedResult(Result):
    """A simulated data set that was written, with the errors of its SLAM poses, if it has some.

    known: of its truth, what ``recording_document`` takes. files: what else was written, by what it is.
    """

    def __init__(
        self,
        dataset: Dataset,
        place: Path,
        *,
        accuracy: SlamAccuracy | None,
        known: Mapping[str, Any],
        files: Mapping[str, Path | None],
    ) -> None:
        self.dataset, self.place, self.accuracy, self.known, self.files = dataset, place, accuracy, known, files
        self.warnings = dataset.warnings

    def tables(self) -> Sequence[blocks.Table]:
        return [] if self.accuracy is None else [error_table(self.accuracy)]

    def remarks(self) -> Sequence[Remark]:
        written = {**self.files, plural(len(self.dataset.trajectories), "simulated trajectory"): self.place}
        return [Remark(f"{what}: {file}") for what, file in written.items() if file is not None]

    def next_step(self) -> NextStep:
        what = f"{self.place} is a data set like any other"
        return NextStep(what, "see what it tells", ("omnibench", "inspect", self.place))

    def document(self) -> blocks.Document:
        return recording_document(self.dataset, accuracy=self.accuracy, **self.known)

    def json(self) -> Mapping[str, Any]:
        accuracy = None if self.accuracy is None else self.accuracy.model_dump()
        runs = len(self.dataset.trajectories)
        return {"dataset": str(self.place), "trajectories": runs, "accuracy": accuracy, "warnings": list(self.warnings)}


def field_table(caption: str, columns: Mapping[str, Mapping[str, float | None]], note: str = "") -> blocks.Table:
    """Numbers by the names of their fields, whose endings give the unit: a row a field, a column each."""
    rows = []
    for name in dict.fromkeys(name for numbers in columns.values() for name in numbers):
        values = [numbers.get(name) for numbers in columns.values()]
        words, _, ending = name.rpartition("_")
        small = all(abs(value) < 1 for value in values if value is not None)
        units = {"m": (1e3, "mm") if small else (1.0, "m"), "rad": (math.degrees(1.0), "°"), "s": (1.0, "s")}
        factor, unit = units.get(ending, (1.0, ""))
        heading = f"{words} ({unit})" if unit else name
        scaled = (value if value is None or isinstance(value, int) else factor * value for value in values)
        shown = (count(each) if isinstance(each, int) else significant(each) for each in scaled)
        rows.append(blocks.Row.of(heading.replace("_", " "), *shown))
    return blocks.Table(caption, blocks.columns("", *columns), tuple(rows), note)


def error_table(accuracy: SlamAccuracy) -> blocks.Table:
    """The errors of reference poses against the truth: of the last pose of each run, and of all poses."""
    note = f"{plural(accuracy.runs, 'run')}, {significant(accuracy.distance_m, 4)} m in all; drift "
    note += f"{_mm(accuracy.drift_position)} mm and {_degrees(accuracy.drift_heading)}° per metre. NEES: squared error "
    note += "over the stated covariance, 3 where that is right. p95: 95 % are smaller."
    both = {"last poses": accuracy.final.model_dump(), "all poses": accuracy.every.model_dump()}
    return field_table("Errors of the reference poses against the truth", both, note)


def _mm(metres: float) -> str:
    return significant(1e3 * metres, 2)


def _degrees(angle: float) -> str:
    return significant(math.degrees(angle), 2)


def reference_kinds(dataset: Dataset) -> Counter[str]:
    """How many references there are other than poses, by kind."""
    told = (run.references for run in dataset.trajectories)
    return Counter(kind for references in told if references is not None for kind in references.kinds.tolist())


def contents_table(dataset: Dataset) -> blocks.Table:
    """The quantities from motion command to reference pose, recorded or not, how many and at what interval."""
    runs, scans = dataset.trajectories, dataset.scans
    rows = []

    def add(name: str, symbol: str, recorded: Sequence[Any], stamps: Sequence[Array], noun: str, remark: str) -> None:
        if not recorded:
            rows.append(blocks.Row.of(blocks.Cell(name, symbol), "not recorded", NOTHING, "", role="muted"))
            return
        if len(recorded) < len(runs):
            remark += f"; in {count(len(recorded))} of {count(len(runs))} runs"
        number = sum(run.samples.count for run in recorded) if noun == "samples" else sum(map(len, stamps))
        gaps = 1e3 * np.concatenate([np.diff(of_run) for of_run in stamps])
        every = NOTHING
        if gaps.any():
            low, every, high = (significant(float(gap), 3) for gap in np.quantile(gaps, [0.01, 0.5, 0.99]))
            every += " ms" if low == high else f" ms ({low} to {high})"
        rows.append(blocks.Row.of(blocks.Cell(name, symbol), f"{count(number)} {noun}", every, remark))

    def having(field: str) -> list[Trajectory]:
        return [run for run in runs if getattr(run, field) is not None]

    commanded, sent = having("omega"), [run for run in having("sent") if run.sent is not None and len(run.sent)]
    different = f"{count(len({(run.v, run.alpha, run.omega) for run in commanded}))} different"
    add("Motion command", "v, α, ω, d", commanded, [np.zeros(len(commanded))], "runs", different)
    orders = [np.asarray(run.sent)[:, 0] for run in sent]
    add("Sent commands", "v, α, ω, t_r", sent, orders, "commands", "as the robot was sent them")
    step, wheels = recording_figures.rate_step(runs[0]), ", ".join(dataset.robot.wheel_names)
    ticks = "by encoders" if step is None else f"by encoders, in steps of {significant(step, 3)} rad/s"
    for name, symbol, field, remark in (
        ("Target wheel rates", "ωM", "targets", "what the motor controllers were told"),
        ("Measured wheel rates", "ω", "rates", f"{wheels}; {ticks}"),
        ("Wheel angles", "φ", "angles", "absolute, continuous within a session"),
        ("Steering angles", "steer", "steering", "at the samples' ends"),
        ("Odometry of the robot", "x, y, θ", "odometry", "as it computed it"),
    ):
        recorded = list(runs) if field == "rates" else having(field)
        if recorded or field != "steering":
            drawn = drawn_runs(recorded) if recorded else []
            add(name, symbol, recorded, [np.append(0.0, run.times) for run in drawn], "samples", remark)
    scanned, device = list[str](), ""
    if scans is not None:
        scanned, scanner = list(scans.trajectories), scans.scanner
        turn = math.degrees(abs(scanner.angle_increment) * (scanner.rays - 1))
        device = f"{scanner.name}: " if scanner.name else ""
        device += f"{count(scanner.rays)} ranges over {significant(turn, 3)}°, to {scanner.range_max:g} m"
    add("LIDAR scans", "", scanned, [scans.times(run) for run in scanned] if scans else [], "scans", device)
    covariances = "with covariances" if len(having("pose_covariances")) == len(runs) else "without covariances"
    posed, symbol = [run for run in runs if run.start_known], "x, y, θ" if scans is None else "x, y, θ by LIDAR"
    add("Reference poses", symbol, posed, [run.pose_times for run in posed], "poses", covariances)
    for kind, number in reference_kinds(dataset).items():
        rows.append(blocks.Row.of(f"References: {kind}", count(number), NOTHING, ""))
    columns = blocks.columns("Recorded", "Number", "Every", blocks.Column("Remarks", numeric=False))
    named = {"": dataset.description, "source: ": dataset.source, "licence: ": dataset.licence}
    note = "; ".join(f"{name}{text}" for name, text in named.items() if text)
    title = f"{dataset.name}, robot {dataset.robot.name}: {kind_of_data(dataset.simulated)}"
    return blocks.Table(title, columns, tuple(rows), note)


def tiles(dataset: Dataset, metres: float) -> list[blocks.Fact]:
    """What was recorded, in numbers. metres: driven in all."""
    runs, kinds = dataset.trajectories, reference_kinds(dataset)
    poses = sum(len(run.poses) for run in runs if run.start_known)
    splits = Counter(run.split for run in runs)
    samples = count(sum(run.samples.count for run in runs))
    return [
        blocks.Fact("Runs", count(len(runs)), ", ".join(f"{number} {split}" for split, number in splits.items())),
        blocks.Fact("Driven", f"{significant(metres, 3)} m", f"in {fixed(sum(run.end for run in runs) / 60, 1)} min"),
        blocks.Fact("Wheel samples", f"every {significant(1e3 * dataset.sample_period, 3)} ms", samples),
        blocks.Fact("References", count(poses + kinds.total()), ", ".join(kinds) or "poses"),
    ]


_RUNS = 50  # runs whose errors are drawn (chosen)


def error_figures(dataset: Dataset, truth: Mapping[str, TruePath]) -> blocks.FigureGrid:
    """The errors of the reference poses over the distance driven; the true path of every run must be known."""
    runs = dataset.trajectories
    drawn = [run_errors(runs[index], truth[runs[index].id]) for index in recording_figures.evenly(len(runs), _RUNS)]
    item, figures = recording_figures.REFERENCE_ITEM, []
    for name, field, unit, scale in (
        ("Position error", "position", "mm", 1e3),
        ("Heading error", "heading", "°", math.degrees(1.0)),
    ):
        lines = joined([np.column_stack([errors.driven, scale * getattr(errors, field)]) for errors in drawn])
        figure = plot(line(item, 1, *lines.T), x_title="distance driven (m)", y_title=f"{name.lower()} ({unit})")
        figure.update_yaxes(rangemode="tozero")
        figures.append(blocks.Figure(f"{name} over the distance driven", figure, f"{name} of every run", 320))
    return blocks.FigureGrid(tuple(figures), name="slam-errors")


class RoomPlan(Protocol):
    """A room whose walls are known.

    start (3,): the robot's mark, m, m, rad. outlines: the walls, closed (n, 2) each, m, in the room's frame.
    """

    @property
    def name(self) -> str: ...
    @property
    def start(self) -> Array: ...
    @property
    def outlines(self) -> Sequence[Array]: ...


def recording_document(
    dataset: Dataset,
    *,
    truth: Mapping[str, TruePath] | None = None,
    plan: RoomPlan | None = None,
    starts: Mapping[str, Array] | None = None,
    accuracy: SlamAccuracy | None = None,
) -> blocks.Document:
    """The report on a recording as blocks: its contents, the room, the wheels, a run step by step.

    For simulated data: truth: true path of each run, which the reference poses are compared with. plan: the room.
    starts: true start pose (3,) of each run in that room, m, m, rad (default: the plan's start). accuracy: errors of
    the reference poses where the truth is not at hand.

    DataError in one line: broken scans, or a truth of other runs.
    """
    known, begun = truth or {}, starts or {}

    def walls(run: Trajectory) -> list[Array]:
        """The walls of the floor plan relative to a run's start, closed (n, 2) each, m."""
        return [] if plan is None else [seen_from(begun.get(run.id, plan.start), each) for each in plan.outlines]

    accuracy = slam_accuracy(dataset, known) if known else accuracy
    metres = sum(float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum()) for run in dataset.trajectories)
    facts, compared = tiles(dataset, metres), list[blocks.Section]()
    if accuracy is not None:
        final, of = accuracy.final, "of the last pose against the truth, mean"
        facts[2:] = [
            blocks.Fact("Position error", f"{_mm(final.position_mean_m)} mm", of),
            blocks.Fact("Heading error", f"{_degrees(final.heading_mean_rad)}°", of),
        ]
        shown = (*((error_figures(dataset, known),) if known else ()), error_table(accuracy))
        compared = [blocks.Section("slam", "SLAM against the truth", shown)]
    names = {run.id for run in dataset.trajectories}
    inexact = f"The floor plan ({plan.name}) is drawn from the robot's mark, wherever a run began." if plan else ""
    answer = blocks.answer_section(
        f"{plural(len(dataset.trajectories), 'run')} of {dataset.robot.name}, {facts[1].value} {facts[1].note}.",
        facts,
        path_overview(dataset, walls),
        *([blocks.Paragraph(inexact, "note")] if plan and not begun.keys() >= names else []),
        blocks.Callout("Warnings on reading the data", dataset.warnings, "warning"),
    )
    return blocks.Document(
        f"Recording: {dataset.name}",
        dataset.description,
        (
            answer,
            *compared,
            *pictures(dataset, known, walls),
            blocks.Section("recorded", "What was recorded", (contents_table(dataset),)),
        ),
        blocks.simulated_badge(dataset.simulated),
    )


Walls = Callable[[Trajectory], Sequence[Array]]  # relative to the start of a run


def path_overview(dataset: Dataset, walls: Walls = lambda _: ()) -> blocks.FigureGrid:
    """The paths of all runs from one start, and the room where there are scans."""
    first = next(iter(recording_figures.representative_runs(dataset).values()))
    return recording_figures.all_runs(dataset, first, walls(first))


def pictures(
    dataset: Dataset, truth: Mapping[str, TruePath] | None = None, walls: Walls = lambda _: ()
) -> list[blocks.Section]:
    """The sections on single runs: played step by step, and their wheel rates."""
    runs, odometry = recording_figures.representative_runs(dataset), OdometryModel.of_design(dataset.robot, "arc")
    outlines = {run.id: [placed(run.start, outline) for outline in walls(run)] for run in runs.values()}
    rates = {name: (recording_figures.wheel_rates(run, dataset.robot),) for name, run in runs.items()}
    return [
        blocks.Section("player", "Step by step", (player(dataset, runs, odometry, truth or {}, outlines),)),
        blocks.Section("wheels", "Wheel rates", (blocks.Choice("Run", rates),)),
    ]
