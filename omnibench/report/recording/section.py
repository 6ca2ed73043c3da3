"""A recording as it is shown, alone and in other reports: contents, paths, wheel rates, runs step by step.

Beside it reference poses by SLAM, with their errors against the truth. The document that templates/player.js plays:
poses, wheel rates and scans of a run, rounded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.stored import drawn_runs
from omnibench.data.true_poses import TruePath
from omnibench.errors import DataError
from omnibench.report import blocks
from omnibench.report.figures import is_placed, joined, line
from omnibench.report.numbers import NOTHING, count, fixed, listing, significant
from omnibench.report.recording import recording_figures
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import INK, PALETTE, plot
from omnibench.robot.kinematics import Array, compose, interpolated, placed, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.slam.slam_dataset import SlamAccuracy, SlamResult, SlamSummary, run_errors, slam_accuracy
from omnibench.words import kind_of_data, plural

_FRAMES = 200  # frames drawn of a run (chosen: steps of the slider that can be told apart)
_MEAN_OVER = 0.1  # s; wheel rates are means over this time before each frame
_SCANS = 30  # scans drawn of a run (chosen: keeps the file small)
_RAYS = 180  # rays drawn of a scan (chosen: keeps the file small)
_MARGIN = 0.4  # m around everything that is drawn
_SEEN = blocks.LegendItem("scan", "this moment's scan", "#d97706")


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
    shown = ["the robot"]
    shown += ["its last scan, and what it saw before"] if dataset.scans is not None else []
    shown += ["the path so far and its wheel rates"]
    return blocks.Player(
        {name: _run(dataset, run, odometry, truth.get(run.id), outlines.get(run.id, ())) for name, run in runs.items()},
        f"A plan of the room with {listing(shown)}, at the time that the slider names",
        "Between reference poses the robot is drawn on a straight line; wheel rates are means over the 100 ms before. "
        "With the slider in focus the arrow keys go step by step.",
    )


def _run(
    dataset: Dataset, run: Trajectory, odometry: OdometryModel, truth: TruePath | None, outlines: Sequence[Array]
) -> dict[str, Any]:
    end, steered = run.end, dataset.robot.drive.steered
    times = np.linspace(0.0, end, min(_FRAMES, max(2, round(end / 0.02) + 1)))
    poses = recording_figures.poses_at(run, times)
    (driven,) = odometry.poses([run.log(times)])
    true_poses = None if truth is None else placed(run.start, truth.at(times))
    scans = _played_scans(dataset, run)
    rates = _means(run, run.rates, times)
    targets = None if run.targets is None else _means(run, run.targets, times)
    everything = [rates] if targets is None else [rates, targets]
    drawn = [poses[:, :2], driven[:, :2], *outlines, *(np.reshape(scan["points"], (-1, 2)) for scan in scans)]
    # Left, bottom, right and top of the picture, m; the farthest 0.5 % of the points on each side are cut off
    points = np.vstack(drawn)
    low, high = np.quantile(points, 0.005, axis=0) - _MARGIN, np.quantile(points, 0.995, axis=0) + _MARGIN
    return {
        "times": _rounded(times),
        "poses": _rounded(poses, 4),
        "odometry": _rounded(driven[:, :2]),
        "truth": None if true_poses is None else _rounded(true_poses),
        "rates": _rounded(rates),
        "targets": None if targets is None else _rounded(targets),
        "rate_limit": round(1.05 * max(float(np.abs(np.vstack(everything)).max()), 1e-3), 3),
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
        "colours": {
            "reference": recording_figures.REFERENCE_ITEM.colour,
            "odometry": recording_figures.ODOMETRY_ITEM.colour,
            "truth": recording_figures.TRUTH_ITEM.colour,
            "plan": recording_figures.PLAN_ITEM.colour,
            "map": recording_figures.SCANS + "66",
            "scan": _SEEN.colour,
            "ray": _SEEN.colour + "44",
            "whole": recording_figures.REFERENCE_ITEM.colour + "55",
            "robot": INK,
        },
        "key": _key(bool(scans), truth is not None, bool(outlines)),
    }


def _played_scans(dataset: Dataset, run: Trajectory) -> list[dict[str, Any]]:
    """Some scans of a run: stamp, scanner position, and points as x, y, x, y, ..., m."""
    if dataset.scans is None or run.id not in dataset.scans.trajectories:
        return []
    scanner, scans = dataset.scans.scanner, dataset.scans.of(run.id)
    stride = -(-scanner.rays // _RAYS)
    documents = []
    for scan in recording_figures.evenly(len(scans.times), _SCANS):
        stamp = scans.times[scan]
        origin = compose(recording_figures.poses_at(run, stamp), scanner.mount.pose)
        points = recording_figures.scan_points(run, scanner, scans, int(scan), stride)
        documents.append(
            {"t": round(float(stamp), 4), "from": _rounded(origin[:2]), "points": _rounded(points.ravel())}
        )
    return documents


def _means(run: Trajectory, values: Array, times: Array) -> Array:
    """Mean rates (n, N) over the 0.1 s before each of ``times`` (n,), s; values (F, N): the rate of each sample."""
    ends = np.append(0.0, run.times)
    durations = np.diff(ends)[:, None]
    angles = np.vstack([np.zeros(values.shape[1]), np.cumsum(values * durations, axis=0)])
    late = np.clip(times, _MEAN_OVER / 2, ends[-1])
    early = np.maximum(late - _MEAN_OVER, 0.0)
    driven = interpolated(late, ends, angles) - interpolated(early, ends, angles)
    means: Array = driven / (late - early)[:, None]
    return means


def _key(scans: bool, truth: bool, plan: bool) -> list[dict[str, Any]]:
    items = (
        [recording_figures.REFERENCE_ITEM, recording_figures.ODOMETRY_ITEM]
        + [recording_figures.TRUTH_ITEM] * truth
        + [recording_figures.PLAN_ITEM] * plan
    )
    points = [_SEEN, blocks.LegendItem("map", "earlier scans", recording_figures.SCANS_ITEM.colour)] * scans
    entries: list[dict[str, Any]] = [{"label": item.label, "colour": item.colour, "points": False} for item in items]
    return entries + [{"label": item.label, "colour": item.colour, "points": True} for item in points]


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
        return [summary_table(summary), *([error_table(summary.accuracy)] if summary.accuracy is not None else [])]

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


def error_table(accuracy: SlamAccuracy) -> blocks.Table:
    """The errors of reference poses against the truth: of the last pose of each run, and of all poses."""
    final, every = accuracy.final, accuracy.every

    def row(name: str, scale: float, *fields: str) -> blocks.Row:
        values = [getattr(of_poses, field) if field else None for of_poses in (final, every) for field in fields]
        signed = fields[0].startswith("bias")
        shown = (NOTHING if value is None else significant(scale * value, 2, signed) for value in values)
        return blocks.Row.of(name, *shown)

    degrees = math.degrees(1.0)
    rows = (
        row("position (mm)", 1e3, *(f"position_{which}_m" for which in ("mean", "p95", "max"))),
        row("heading (°)", degrees, *(f"heading_{which}_rad" for which in ("mean", "p95", "max"))),
        row("forward, signed (mm)", 1e3, "bias_forward_m", "", ""),
        row("to the left, signed (mm)", 1e3, "bias_left_m", "", ""),
        row("heading, signed (°)", degrees, "bias_heading_rad", "", ""),
        row("NEES", 1.0, "nees_mean", "", ""),
    )
    drift = f"{_mm(accuracy.drift_position)} mm and {_degrees(accuracy.drift_heading)}° per metre"
    columns = [
        blocks.Column(f"{poses}, {which}", priority=int(which != "mean"))
        for poses in ("last poses", "all poses")
        for which in ("mean", "95 %", "worst")
    ]
    return blocks.Table(
        "Errors of the reference poses against the truth",
        (blocks.Column("error", numeric=False), *columns),
        rows,
        f"{plural(accuracy.runs, 'run')}, {significant(accuracy.distance_m, 4)} m in all; drift {drift}. NEES: squared "
        "error over the stated covariance, 3 where that is right.",
    )


def summary_table(summary: SlamSummary) -> blocks.Table:
    """The deviations that SLAM states, and the distances from the reference poses that were recorded."""
    deviations = (_mm(summary.position_deviation_mean_m), NOTHING, _mm(summary.position_deviation_max_m))
    turns = (_degrees(summary.heading_deviation_mean_rad), NOTHING, _degrees(summary.heading_deviation_max_rad))
    rows = [blocks.Row.of("deviation stated at the end of a run", *deviations, *turns)]
    if (known := summary.recorded) is not None:
        lengths = (_mm(known.position_mean_m), _mm(known.position_p95_m), NOTHING)
        angles = (_degrees(known.heading_mean_rad), _degrees(known.heading_p95_rad), NOTHING)
        name = blocks.Cell("distance from the recorded reference", plural(known.poses, "pose"))
        rows.append(blocks.Row.of(name, *lengths, *angles))
    columns = (
        blocks.Column("Poses", numeric=False),
        *(blocks.Column(f"position, {which}", "mm") for which in ("mean", "95 %", "worst")),
        *(blocks.Column(f"heading, {which}", "°") for which in ("mean", "95 %", "worst")),
    )
    counts = f"{plural(summary.runs, 'run')}, {plural(summary.scans, 'scan')}"
    matched = f"{summary.matched_mean:.1%} of the points matched (worst scan {summary.matched_min:.0%})"
    title = f"{summary.dataset}, {kind_of_data(summary.simulated)}: reference poses from the scans"
    return blocks.Table(title, columns, tuple(rows), f"{counts}; {matched}")


def _mm(metres: float) -> str:
    return significant(1e3 * metres, 2)


def _degrees(angle: float) -> str:
    return significant(math.degrees(angle), 2)


def contents_table(dataset: Dataset) -> blocks.Table:
    """A table of the quantities from motion command to SLAM pose: recorded or not, how many, at what interval."""
    runs, scans = dataset.trajectories, dataset.scans
    rows = []

    def add(name: str, symbol: str, recorded: Sequence[Any], times: Sequence[Array], noun: str, remark: str) -> None:
        if not recorded:
            rows.append(blocks.Row.of(blocks.Cell(name, symbol), "not recorded", NOTHING, "", role="muted"))
            return
        if len(recorded) < len(runs):
            remark += f"; in {count(len(recorded))} of {count(len(runs))} runs"
        number = sum(run.samples.count for run in recorded) if noun == "samples" else sum(map(len, times))
        every = _every(times) if noun != "runs" else NOTHING
        rows.append(blocks.Row.of(blocks.Cell(name, symbol), f"{count(number)} {noun}", every, remark))

    def having(field: str) -> list[Trajectory]:
        return [run for run in runs if getattr(run, field) is not None]

    def stamps(some: Sequence[Trajectory]) -> list[Array]:
        return [np.append(0.0, run.times) for run in drawn_runs(some)] if some else []

    commanded, sent = having("omega"), [run for run in having("sent") if len(run.sent or ())]
    different = len({(run.v, run.alpha, run.omega) for run in commanded})
    add(
        "Motion command", "(v, α, ω, d)", commanded, [np.zeros(len(commanded))], "runs", f"{count(different)} different"
    )
    orders = [np.asarray(run.sent)[:, 0] for run in sent]
    add("Sent commands", "(v, α, ω, t_r)", sent, orders, "commands", "as the robot was sent them")
    step = recording_figures.rate_step(runs[0])
    ticks = "by encoders" if step is None else f"by encoders, in steps of {significant(step, 3)} rad/s"
    for name, symbol, field, remark in (
        ("Target wheel rates", "ωM", "targets", "what the motor controllers were told"),
        ("Measured wheel rates", "ω", "rates", ticks),
        ("Wheel angles", "φ", "angles", "absolute, continuous within a session"),
        ("Steering angles", "steer", "steering", "at the samples' ends"),
        ("Odometry of the robot", "(x, y, θ)", "odometry", "as it computed it"),
    ):
        recorded = list(runs) if field == "rates" else having(field)
        if recorded or field != "steering":
            add(name, symbol, recorded, stamps(recorded), "samples", remark)
    scanned = [] if scans is None else list(scans.trajectories)
    device = ""
    if scans is not None:
        turn = np.degrees(abs(scans.scanner.angle_increment) * (scans.scanner.rays - 1))
        device = f"{scans.scanner.name}: " if scans.scanner.name else ""
        device += (
            f"{count(scans.scanner.rays)} ranges over {significant(float(turn), 3)}°, to {scans.scanner.range_max:g} m"
        )
    times = [] if scans is None else [scans.times(run) for run in scanned]
    add("LIDAR scans", "LIDAR", scanned, times, "scans", device)
    covariances = "with covariances" if len(having("pose_covariances")) == len(runs) else "without covariances"
    symbol = "(x, y, θ)" if scans is None else "(x, y, θ) LIDAR"
    add("Reference poses", symbol, runs, [run.pose_times for run in runs], "poses", covariances)
    columns = (
        blocks.Column("Recorded", numeric=False),
        blocks.Column("Number"),
        blocks.Column("Every"),
        blocks.Column("Remarks", numeric=False),
    )
    note = "Every: the median interval; where they vary, in brackets the range that holds 98 % of them."
    return blocks.Table("What was recorded", columns, tuple(rows), note)


def _every(times: Sequence[Array]) -> str:
    """The interval between stamps in words."""
    gaps = 1e3 * np.concatenate([np.diff(run) for run in times])
    if not len(gaps):
        return NOTHING
    low, middle, high = (significant(float(gap), 3) for gap in np.quantile(gaps, [0.01, 0.5, 0.99]))
    return f"{middle} ms" if low == high else f"{middle} ms ({low} to {high})"


_RUNS = 50  # runs drawn as thin lines (chosen)
_BINS = 16  # bins of distance (chosen)
_LEAST = 5  # poses; a bin with fewer shows no mean (chosen)
_RUN = blocks.LegendItem("run", "a run", "#c3c9d0")
_MEAN = blocks.LegendItem("mean", "mean", PALETTE[0])
_HIGH = blocks.LegendItem("high", "95th percentile", PALETTE[2], "dash")


def error_figures(dataset: Dataset, truth: Mapping[str, TruePath]) -> blocks.FigureGrid:
    """The errors of the reference poses over the distance driven; the true path of every run must be known."""
    errors = [run_errors(run, truth[run.id]) for run in dataset.trajectories]
    drawn = [errors[index] for index in recording_figures.evenly(len(errors), _RUNS)]
    way = np.concatenate([run.driven for run in errors])
    edges = np.linspace(0.0, float(way.max()) * (1 + 1e-9) or 1.0, _BINS + 1)
    bin_of = np.digitize(way, edges) - 1
    bins = [index for index in range(_BINS) if (bin_of == index).sum() >= _LEAST]
    middles = np.array([float(way[bin_of == index].mean()) for index in bins])
    figures = []
    for name, field, unit, scale in (
        ("Position error", "position", "mm", 1e3),
        ("Heading error", "heading", "°", math.degrees(1.0)),
    ):
        lines = joined([np.column_stack([run.driven, scale * getattr(run, field)]) for run in drawn])
        values = scale * np.concatenate([getattr(run, field) for run in errors])
        traces = [line(_RUN, 0.8, *lines.T, opacity=0.6)]
        for item, share in ((_MEAN, None), (_HIGH, 0.95)):
            parts = [values[bin_of == index] for index in bins]
            levels = np.array([part.mean() if share is None else np.quantile(part, share) for part in parts])
            traces.append(line(item, 2.4, middles, levels, hover=f"{item.label} %{{y:.3g}} {unit} at %{{x:.2f}} m"))
        figure = plot(*traces, x_title="distance driven (m)", y_title=f"{name.lower()} ({unit})")
        figure.update_yaxes(rangemode="tozero")
        title = f"{name} over the distance driven"
        figures.append(blocks.Figure(title, figure, f"{title} of every run, with mean and 95th percentile", 320))
    return blocks.FigureGrid(tuple(figures), (_RUN, _MEAN, _HIGH), 2, "", "slam-errors")


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
    notes: Sequence[str] = (),
) -> blocks.Document:
    """The report on a recording as blocks: its contents, the room, the wheels, a run step by step.

    For simulated data: truth: true path of each run, which the reference poses are compared with. plan: the room.
    starts: true start pose (3,) of each run in that room, m, m, rad (default: the plan's start). accuracy: errors of
    the reference poses (default: computed from the truth). notes: remarks at the top of the report.

    DataError in one line: broken scans, or a truth of other runs.
    """
    known = truth or {}
    for run in dataset.trajectories if known else ():
        if run.id not in known:
            raise DataError(
                f"data set {dataset.name}: run {run.id} is not in the truth; name the truth of this data set"
            )
    if known and accuracy is None:
        accuracy = slam_accuracy(dataset, known)
    runs = dataset.trajectories
    seconds = sum(run.end for run in runs)
    metres = sum(float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum()) for run in runs)
    length, minutes = f"{significant(metres, 3)} m", f"{fixed(seconds / 60, 1)} min"
    sentence = f"{plural(len(runs), 'run')} of {dataset.robot.name}, {length} in {minutes}."
    tiles = [
        blocks.Fact("Runs", count(len(runs))),
        blocks.Fact("Driven", length, f"in {minutes}"),
        blocks.Fact("Wheel samples", f"every {significant(1e3 * dataset.sample_period, 3)} ms"),
        blocks.Fact("Reference poses", count(sum(len(run.poses) for run in runs))),
    ]
    sections = []
    if accuracy is not None:
        final = accuracy.final
        errors = f"{_mm(final.position_mean_m)} mm and {_degrees(final.heading_mean_rad)}°"
        sentence += f" Mean error of their last reference pose against the truth: {errors}."
        tiles[2:] = [
            blocks.Fact("Position error", f"{_mm(final.position_mean_m)} mm", "of the last pose, mean"),
            blocks.Fact("Heading error", f"{_degrees(final.heading_mean_rad)}°", "of the last pose, mean"),
        ]
        shown = (*((error_figures(dataset, known),) if known else ()), error_table(accuracy))
        about = "Errors of the reference poses over the distance driven, and whether their covariances are right."
        sections.append(blocks.Section("slam", "SLAM against the truth", shown, about=about))
    answer = blocks.answer_section(
        sentence,
        tiles,
        path_overview(dataset, plan, starts),
        blocks.Callout("Before you rely on it", tuple(notes)),
        blocks.Callout("Warnings on reading the data", dataset.warnings, "warning"),
    )
    contents = (contents_table(dataset), about_table(dataset))
    about = "Quantities, numbers and intervals, from motion command to reference pose."
    return blocks.Document(
        f"Recording: {dataset.name}",
        dataset.description,
        (
            answer,
            *sections,
            *pictures(dataset, truth=known, plan=plan, starts=starts),
            blocks.Section("recorded", "What was recorded", contents, about=about),
        ),
        blocks.simulated_badge(dataset.simulated),
    )


def path_overview(
    dataset: Dataset, plan: RoomPlan | None = None, starts: Mapping[str, Array] | None = None
) -> blocks.FigureGrid:
    """The paths of all runs from one start, and the room where there are scans."""
    first = next(iter(recording_figures.representative_runs(dataset).values()))
    return recording_figures.all_runs(dataset, first, _outlines(plan, (starts or {}).get(first.id)))


def has_recording(dataset: Dataset) -> bool:
    """True if a data set holds more than wheel rates and poses: scans, or targets of the wheels."""
    return dataset.scans is not None or any(run.targets is not None for run in dataset.trajectories)


def recording_section(dataset: Dataset) -> blocks.Section:
    """The section on a recording for another report. DataError in one line: broken scans."""
    paths = blocks.Section("recording-paths", "Paths of all runs", (path_overview(dataset),))
    parts = (paths, *pictures(dataset, prefix="recording-"))
    about = "What was recorded, all paths, wheel rates, and runs step by step."
    return blocks.Section("recording", "Recording", (contents_table(dataset),), parts, about=about, folded=True)


def about_table(dataset: Dataset) -> blocks.Facts:
    """Name, source, licence and robot of a data set."""
    facts = [
        blocks.Fact("Data set", dataset.name, "simulated" if dataset.simulated else ""),
        blocks.Fact("Description", dataset.description),
        blocks.Fact("Source", dataset.source),
        blocks.Fact("Licence", dataset.licence),
        blocks.Fact("Robot", dataset.robot.name),
    ]
    return blocks.Facts(tuple(fact for fact in facts if fact.value))


def pictures(
    dataset: Dataset,
    *,
    prefix: str = "",
    truth: Mapping[str, TruePath] | None = None,
    plan: RoomPlan | None = None,
    starts: Mapping[str, Array] | None = None,
) -> list[blocks.Section]:
    """The sections on single runs: played step by step, and their wheel rates."""
    known, begun = truth or {}, starts or {}
    runs = recording_figures.representative_runs(dataset)
    odometry = OdometryModel.of_design(dataset.robot, "arc")
    walls = {
        run.id: [placed(run.start, outline) for outline in _outlines(plan, begun.get(run.id))] for run in runs.values()
    }
    exact = plan is None or all(run.id in begun for run in runs.values())
    words = (
        "" if plan is None else f"The floor plan ({plan.name}) is drawn from the robot's mark; for a run that began "
    )
    words += "beside the mark it is shifted by that distance."
    played = (player(dataset, runs, odometry, known, walls), *(() if exact else (blocks.Paragraph(words, "note"),)))
    rates = {name: (recording_figures.wheel_rates(run, dataset.robot),) for name, run in runs.items()}
    about = "A run of each kind of motion, played: robot, paths, scans, wheel rates."
    return [
        blocks.Section(f"{prefix}player", "Step by step", played, about=about),
        blocks.Section(
            f"{prefix}wheels", "Wheel rates", (blocks.Choice("Run", rates),), about="Measured, and as told."
        ),
    ]


def _outlines(plan: RoomPlan | None, start: Array | None) -> list[Array]:
    """The walls of a floor plan relative to a start pose (3,) in it (default: its own), closed (n, 2) each, m."""
    if plan is None:
        return []
    return [seen_from(plan.start if start is None else start, outline) for outline in plan.outlines]
