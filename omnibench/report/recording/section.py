"""The report on a recording, and the section on it that other reports include.

Figures of the errors of reference poses against the truth: over time and distance, at the end, and their NEES. Tables
of reference poses by SLAM, which are the terminal's, too. The document that templates/player.js plays: poses, wheel
rates and scans of a run, rounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.stored import drawn_runs
from omnibench.data.true_poses import TruePath
from omnibench.errors import DataError
from omnibench.report import blocks
from omnibench.report.figures import coordinates, is_placed, joined, line
from omnibench.report.numbers import NOTHING, count, fixed, listing, significant
from omnibench.report.recording import recording_figures
from omnibench.report.style import INK, PALETTE, QUIET, plot
from omnibench.robot.kinematics import Array, compose, interpolated, placed, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.slam.slam_dataset import ErrorSummary, RunErrors, SlamAccuracy, SlamSummary, run_errors, slam_accuracy
from omnibench.words import plural

_FRAMES = 240  # frames drawn of a run (chosen: steps of the slider that can be told apart)
_MEAN_OVER = 0.1  # s; wheel rates are means over this time before each frame
_SCANS = 60  # scans drawn of a run (chosen: keeps the file small)
_RAYS = 270  # rays drawn of a scan (chosen: keeps the file small)
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


def accuracy_tiles(accuracy: SlamAccuracy) -> tuple[blocks.Fact, ...]:
    """The errors of reference poses against the truth as a few figures."""
    final = accuracy.final
    position, heading = _mm(final.position_mean_m), _degrees(final.heading_mean_rad)
    drift, turn = _mm(accuracy.drift_position), _degrees(accuracy.drift_heading)
    return (
        blocks.Fact("Final position error, mean", f"{position} mm", f"95 % below {_mm(final.position_p95_m)} mm"),
        blocks.Fact("Final heading error, mean", f"{heading}°", f"95 % below {_degrees(final.heading_p95_rad)}°"),
        blocks.Fact("Drift", f"{drift} mm per metre", f"heading {turn}° per metre"),
        blocks.Fact("NEES, mean of all poses", _nees(accuracy.every), "3 where covariances are right"),
    )


def error_table(accuracy: SlamAccuracy) -> blocks.Table:
    """The errors of the last pose of each run, and of all poses."""
    rows = []
    for name, summary in _summaries(accuracy):
        positions = (summary.position_mean_m, summary.position_p95_m, summary.position_max_m)
        headings = (summary.heading_mean_rad, summary.heading_p95_rad, summary.heading_max_rad)
        rows.append(
            blocks.Row.of(
                blocks.Cell(name, plural(summary.poses, "pose")), *_figures(positions, headings), _nees(summary)
            )
        )
    return blocks.Table(
        caption="Errors of the reference poses against the truth",
        columns=(*_FIGURES, blocks.Column("NEES, mean")),
        rows=tuple(rows),
        note=f"{plural(accuracy.runs, 'run')}, {significant(accuracy.distance_m, 4)} m in all. Drift: the "
        "growth k of the error over the distance s, from error² = noise² + (k s)²; 0 where it does not grow.",
    )


def bias_table(accuracy: SlamAccuracy) -> blocks.Table:
    """The mean errors along the robot's axes."""
    rows = []
    for name, summary in _summaries(accuracy):
        lengths = (_mm(v, signed=True) for v in (summary.bias_forward_m, summary.bias_left_m))
        rows.append(blocks.Row.of(name, *lengths, _degrees(summary.bias_heading_rad, signed=True)))
    return blocks.Table(
        caption="Mean error along the robot's axes",
        columns=(
            blocks.Column("Poses", numeric=False),
            blocks.Column("forward", "mm"),
            blocks.Column("to the left", "mm"),
            blocks.Column("heading", "°"),
        ),
        rows=tuple(rows),
        note="The signed mean of the errors: 0 for a reference without bias.",
    )


def summary_table(summary: SlamSummary) -> blocks.Table:
    """The deviations that SLAM states, and the distances from the reference poses that were recorded."""
    deviations = _figures(
        (summary.position_deviation_mean_m, None, summary.position_deviation_max_m),
        (summary.heading_deviation_mean_rad, None, summary.heading_deviation_max_rad),
    )
    rows = [blocks.Row.of("deviation stated at the end of a run", *deviations)]
    if summary.recorded is not None:
        recorded = summary.recorded
        name = blocks.Cell("distance from the recorded reference", plural(recorded.poses, "pose"))
        distances = _figures(
            (recorded.position_mean_m, recorded.position_p95_m, None),
            (recorded.heading_mean_rad, recorded.heading_p95_rad, None),
        )
        rows.append(blocks.Row.of(name, *distances))
    return blocks.Table("Reference poses from the scans", _FIGURES, tuple(rows))


_FIGURES = (
    blocks.Column("Poses", numeric=False),
    *(blocks.Column(f"position, {which}", "mm") for which in ("mean", "95 %", "worst")),
    *(blocks.Column(f"heading, {which}", "°") for which in ("mean", "95 %", "worst")),
)


def _figures(metres: Sequence[float | None], radians: Sequence[float | None]) -> list[str]:
    """Mean, 95th percentile and maximum of positions in mm, then of headings in degrees."""
    lengths = [NOTHING if value is None else _mm(value) for value in metres]
    return lengths + [NOTHING if value is None else _degrees(value) for value in radians]


def _summaries(accuracy: SlamAccuracy) -> tuple[tuple[str, ErrorSummary], ...]:
    return (("last of each run", accuracy.final), ("all after the first", accuracy.every))


def _mm(metres: float, signed: bool = False) -> str:
    return significant(1e3 * metres, 2, signed)


def _degrees(angle: float, signed: bool = False) -> str:
    return significant(math.degrees(angle), 2, signed)


def _nees(summary: ErrorSummary) -> str:
    return NOTHING if summary.nees_mean is None else significant(summary.nees_mean, 3)


def contents_table(dataset: Dataset) -> blocks.Table:
    """A table of the quantities from motion command to SLAM pose: recorded or not, how many, at what interval."""
    runs = dataset.trajectories
    steers, step = runs[0].steering is not None, recording_figures.rate_step(runs[0])
    rows = [
        _commands(runs),
        _sent(runs),
        _wheels("Target wheel rates", _rates("ωM", dataset), runs, "targets", "what the motor controllers were told"),
        _row(
            "Measured wheel rates",
            _rates("ω", dataset),
            sum(run.samples.count for run in runs),
            "samples",
            _every_sample(runs),
            "by encoders" if step is None else f"by encoders, in steps of {significant(step, 3)} rad/s",
        ),
        _wheels("Wheel angles", "φ", runs, "angles", "absolute, continuous within a session"),
        *([_wheels("Steering angles", "steer", runs, "steering", "at the samples' ends")] if steers else []),
        _wheels("Odometry of the robot", "(x, y, θ)", runs, "odometry", "as it computed it"),
        _scans(dataset),
        _reference(dataset),
    ]
    return blocks.Table(
        caption="What was recorded",
        columns=(
            blocks.Column("Recorded", numeric=False),
            blocks.Column("Number"),
            blocks.Column("Every"),
            blocks.Column("Remarks", numeric=False),
        ),
        rows=tuple(rows),
        note="Small print: symbols. Every: the median interval; where they "
        "vary, in brackets the range that holds 98 % of them.",
    )


def _rates(symbol: str, dataset: Dataset) -> str:
    """The paper's symbols of wheel rates; those of wheels with longer names than its a, b, c as words."""
    names = dataset.robot.wheel_names
    if all(len(name) == 1 for name in names):
        return f"({', '.join(symbol + name for name in names)})"
    return f"{symbol} of {', '.join(names)}"


def _commands(runs: Sequence[Trajectory]) -> blocks.Row:
    commanded = [run for run in runs if run.omega is not None]
    if not commanded:
        return _missing("Motion command", "(v, α, ω, d)")
    different = len({(run.v, run.alpha, run.omega) for run in commanded})
    limit = "length d" if any(run.distance is not None for run in commanded) else "no length"
    remark = f"{count(different)} different, {limit}" + (", duration" if commanded[0].duration is not None else "")
    return _row("Motion command", "(v, α, ω, d)", len(commanded), "runs", "", remark)


def _sent(runs: Sequence[Trajectory]) -> blocks.Row:
    sent = [run.sent for run in runs if run.sent is not None and len(run.sent)]
    if not sent:
        return _missing("Sent commands", "(v, α, ω, t_r)")
    number, longest = sum(map(len, sent)), max(float(commands[:, 4].max()) for commands in sent)
    every = _every([commands[:, 0] for commands in sent])
    return _row("Sent commands", "(v, α, ω, t_r)", number, "commands", every, f"valid for up to {longest:g} s")


def _wheels(name: str, symbol: str, runs: Sequence[Trajectory], field: str, remark: str) -> blocks.Row:
    recorded = [run for run in runs if getattr(run, field) is not None]
    if not recorded:
        return _missing(name, symbol)
    if len(recorded) < len(runs):
        remark += f"; in {count(len(recorded))} of {count(len(runs))} runs"
    return _row(name, symbol, sum(run.samples.count for run in recorded), "samples", _every_sample(recorded), remark)


def _scans(dataset: Dataset) -> blocks.Row:
    if dataset.scans is None:
        return _missing("LIDAR scans", "LIDAR")
    scanner = dataset.scans.scanner
    times = [dataset.scans.times(run) for run in dataset.scans.trajectories]
    turn = np.degrees(abs(scanner.angle_increment) * (scanner.rays - 1))
    name = f"{scanner.name}: " if scanner.name else ""
    remark = f"{name}{count(scanner.rays)} ranges over {significant(float(turn), 3)}°, to {scanner.range_max:g} m"
    if len(times) < len(dataset.trajectories):
        remark += f"; in {count(len(times))} of {count(len(dataset.trajectories))} runs"
    return _row("LIDAR scans", "LIDAR", sum(map(len, times)), "scans", _every(times), remark)


def _reference(dataset: Dataset) -> blocks.Row:
    runs = dataset.trajectories
    times = [run.pose_times for run in runs]
    with_covariance = sum(run.pose_covariances is not None for run in runs)
    remark = "with covariances" if with_covariance == len(runs) else "without covariances"
    if 0 < with_covariance < len(runs):
        remark = f"with covariances in {count(with_covariance)} of {count(len(runs))} runs"
    symbol = "(x, y, θ)" if dataset.scans is None else "(x, y, θ) LIDAR"
    return _row("Reference poses", symbol, sum(map(len, times)), "poses", _every(times), remark)


def _every_sample(runs: Sequence[Trajectory]) -> str:
    """The interval between wheel samples in words."""
    return _every([np.append(0.0, run.times) for run in drawn_runs(runs)])


def _every(times: Sequence[Array]) -> str:
    """The interval between stamps in words."""
    gaps = 1e3 * np.concatenate([np.diff(run) for run in times])
    if not len(gaps):
        return NOTHING
    low, middle, high = np.quantile(gaps, [0.01, 0.5, 0.99])
    if high - low < 0.02 * middle:
        return f"{significant(float(middle), 3)} ms"
    return f"{significant(float(middle), 3)} ms ({significant(float(low), 3)} to {significant(float(high), 3)})"


def _row(name: str, symbol: str, number: int, noun: str, every: str, remark: str) -> blocks.Row:
    return blocks.Row.of(blocks.Cell(name, symbol), f"{count(number)} {noun}", every or NOTHING, remark)


def _missing(name: str, symbol: str) -> blocks.Row:
    return blocks.Row.of(blocks.Cell(name, symbol), "not recorded", NOTHING, "", role="muted")


_RUNS = 150  # runs drawn as thin lines (chosen)
_BINS = 16  # bins of time or distance (chosen)
_LEAST = 5  # poses; a bin with fewer shows no mean (chosen)

_RUN = blocks.LegendItem("run", "a run", "#c3c9d0")
_MEAN = blocks.LegendItem("mean", "mean", PALETTE[0])
_HIGH = blocks.LegendItem("high", "95th percentile", PALETTE[2], "dash")
_EXPECTED = blocks.LegendItem("", "expected", INK)


def error_figures(dataset: Dataset, truth: Mapping[str, TruePath]) -> tuple[blocks.Block, ...]:
    """Figures of the errors of the reference poses; the true path of every run must be known."""
    errors = [run_errors(run, truth[run.id]) for run in dataset.trajectories]
    figures = [
        _curves(errors, lambda e: e.times, lambda e: 1e3 * e.position, "t (s)", "position error (mm)"),
        _curves(errors, lambda e: e.times, lambda e: np.degrees(e.heading), "t (s)", "heading error (°)"),
        _curves(errors, lambda e: e.driven, lambda e: 1e3 * e.position, "distance (m)", "position error (mm)"),
        _curves(errors, lambda e: e.driven, lambda e: np.degrees(e.heading), "distance (m)", "heading error (°)"),
        _histogram([1e3 * e.position[-1] for e in errors], "mm", "Final position errors"),
        _histogram([float(np.degrees(e.heading[-1])) for e in errors], "°", "Final heading errors"),
    ]
    drawn = f", of which {count(_RUNS)} are drawn as thin lines" if len(errors) > _RUNS else ""
    caption = (
        f"{plural(len(errors), 'run')}{drawn}; mean and percentile in bins of time or distance. Errors are "
        "magnitudes at the stamps of the reference poses, without the start."
    )
    curves = blocks.FigureGrid(tuple(figures), (_RUN, _MEAN, _HIGH), 2, caption)
    return (curves, *_nees_figures(errors))


def _nees_figures(errors: Sequence[RunErrors]) -> tuple[blocks.Block, ...]:
    """The normalised estimation error squared (NEES): its distribution and its course over time."""
    known = [run.of(np.isfinite(run.nees)) for run in errors if run.nees is not None]
    if not sum(len(run.times) for run in known):
        return ()
    values = np.concatenate([_squares(run) for run in known])
    limit = max(12.0, 1.2 * float(np.quantile(values, 0.98)))
    edges = np.linspace(0.0, limit, 40)
    heights, _ = np.histogram(values, edges)
    share = heights / len(values) / np.diff(edges)
    x = np.linspace(0.0, limit, 200)
    bars = _bars(edges, share, 0.6, "%{y:.3f} at %{x:.1f}")
    density = np.sqrt(x / (2 * np.pi)) * np.exp(-x / 2)  # chi-squared with three degrees of freedom
    distribution = blocks.Figure(
        f"NEES of all poses: mean {significant(float(values.mean()), 3)}",
        plot(bars, line(_EXPECTED, 2.0, x, density), x_title="NEES", y_title="density"),
        "Histogram of the normalised squared errors with the density that right covariances give",
        340,
    )
    time = _curves(known, lambda e: e.times, _squares, "t (s)", "NEES", level=3.0)
    beyond = int((values > limit).sum())
    outside = f"{count(beyond)} of {count(len(values))} lie beyond the histogram." if beyond else ""
    caption = (
        "NEES: the squared error weighted by the inverse covariance. Its mean is 3 (line) where covariances are right, "
        f"and larger where they are too small. {outside}"
    )
    return (blocks.FigureGrid((distribution, time), (_RUN, _MEAN, _HIGH), 2, caption.strip()),)


def _squares(errors: RunErrors) -> Array:
    assert errors.nees is not None  # runs without covariances are left out before
    return errors.nees


def _curves(
    errors: Sequence[RunErrors],
    along: Callable[[RunErrors], Array],
    value: Callable[[RunErrors], Array],
    x_title: str,
    y_title: str,
    level: float | None = None,
) -> blocks.Figure:
    """The errors of runs as thin lines, with mean and 95th percentile in bins."""
    drawn = [errors[index] for index in recording_figures.evenly(len(errors), _RUNS)]
    lines = joined([np.column_stack([along(run), value(run)]) for run in drawn])
    x, y = (np.concatenate([quantity(run) for run in errors]) for quantity in (along, value))
    edges = np.linspace(0.0, float(x.max()) * (1 + 1e-9) or 1.0, _BINS + 1)
    bin_of = np.digitize(x, edges) - 1
    bins = [index for index in range(_BINS) if (bin_of == index).sum() >= _LEAST]
    middles = np.array([float(x[bin_of == index].mean()) for index in bins])
    traces = [line(_RUN, 0.8, *lines.T, opacity=0.6)]
    for item, statistic in ((_MEAN, np.mean), (_HIGH, lambda v: np.quantile(v, 0.95))):
        level_of = np.array([float(statistic(y[bin_of == index])) for index in bins])
        traces.append(line(item, 2.4, middles, level_of, hover=f"{item.label} %{{y:.3g}} at %{{x:.2f}}"))
    figure = plot(*traces, x_title=x_title, y_title=y_title)
    figure.update_yaxes(rangemode="tozero")
    if level is not None:
        figure.add_hline(level, line={"color": QUIET, "width": 1})
    name, by = y_title.split(" (")[0], "time" if x_title.startswith("t ") else "distance driven"
    title = f"{name[:1].upper()}{name[1:]} over {by}"
    return blocks.Figure(title, figure, f"{title} of every run, with its mean and 95th percentile", 340)


def _histogram(values: Sequence[float], unit: str, title: str) -> blocks.Figure:
    heights, edges = np.histogram(values, bins=min(40, max(8, len(values) // 8)))
    bars = _bars(edges, heights, 0.75, f"%{{y}} runs about %{{x:.3g}} {unit}")
    mean, high = float(np.mean(values)), float(np.quantile(values, 0.95))
    gap = "" if unit == "°" else " "
    headline = f"{title}: mean {significant(mean, 2)}{gap}{unit}, 95 % below {significant(high, 2)}{gap}{unit}"
    figure = plot(bars, x_title=f"error ({unit})", y_title="runs", bargap=0)
    return blocks.Figure(headline, figure, f"Histogram of {title.lower()} in {unit}", 320)


def _bars(edges: Array, heights: Array, opacity: float, hover: str) -> go.Bar:
    return go.Bar(
        x=coordinates((edges[:-1] + edges[1:]) / 2),
        y=coordinates(heights),
        width=float(edges[1] - edges[0]),
        marker={"color": PALETTE[0], "opacity": opacity},
        hovertemplate=f"{hover}<extra></extra>",
    )


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
    sections = [_answer(dataset, notes, accuracy, path_overview(dataset, plan, starts))]
    if accuracy is not None:
        errors = error_figures(dataset, known) if known else ()
        about = "Errors of the reference poses, over time and distance, and whether their covariances are right."
        tables = (error_table(accuracy), bias_table(accuracy))
        sections.append(blocks.Section("slam", "SLAM against the truth", (*tables, *errors), about=about, folded=True))
    sections += pictures(dataset, truth=known, plan=plan, starts=starts)
    contents = (contents_table(dataset), about_table(dataset))
    about = "Quantities, numbers and intervals, from motion command to reference pose."
    sections.append(blocks.Section("recorded", "What was recorded", contents, about=about, folded=True))
    return blocks.Document(
        title=f"Recording: {dataset.name}",
        subtitle=dataset.description,
        sections=tuple(sections),
        badges=blocks.simulated_badge(dataset.simulated),
    )


def _answer(
    dataset: Dataset, notes: Sequence[str], accuracy: SlamAccuracy | None, picture: blocks.FigureGrid
) -> blocks.Section:
    """What is in a recording or, where the truth is known, how accurate its reference poses are; and its paths."""
    runs = dataset.trajectories
    seconds = sum(run.end for run in runs)
    metres = sum(float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum()) for run in runs)
    sentence = f"{plural(len(runs), 'run')} of {dataset.robot.name}, {significant(metres, 3)} m in {_minutes(seconds)}"
    tiles: tuple[blocks.Fact, ...] = (
        blocks.Fact("Runs", count(len(runs))),
        blocks.Fact("Driven", f"{significant(metres, 3)} m", f"in {_minutes(seconds)}"),
        blocks.Fact("Wheel samples", f"every {significant(1e3 * dataset.sample_period, 3)} ms"),
        blocks.Fact("Reference poses", count(sum(len(run.poses) for run in runs))),
    )
    if accuracy is not None:
        final = accuracy.final
        errors = f"{_mm(final.position_mean_m)} mm and {_degrees(final.heading_mean_rad)}°"
        sentence += f". Their reference poses end {errors} from the truth on average"
        tiles = accuracy_tiles(accuracy)
    return blocks.answer_section(
        f"{sentence}.",
        tiles,
        picture,
        blocks.Callout("Before you rely on it", tuple(notes)),
        blocks.Callout("Warnings on reading the data", dataset.warnings, "warning"),
    )


def path_overview(
    dataset: Dataset, plan: RoomPlan | None = None, starts: Mapping[str, Array] | None = None
) -> blocks.FigureGrid:
    """The paths of all runs from one start, and the room where there are scans."""
    first = next(iter(recording_figures.representative_runs(dataset).values()))
    return recording_figures.all_runs(dataset, first, _outlines(plan, (starts or {}).get(first.id)))


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{fixed(seconds / 60, 1)} min"


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
    """The sections on single runs: in their room, wheel rates, and the step-by-step player."""
    known, begun = truth or {}, starts or {}
    runs = recording_figures.representative_runs(dataset)
    odometry = OdometryModel.of_design(dataset.robot, "arc")
    from_start = {run.id: _outlines(plan, begun.get(run.id)) for run in runs.values()}
    walls = {run.id: [placed(run.start, outline) for outline in from_start[run.id]] for run in runs.values()}
    rooms: dict[str, tuple[blocks.Block, ...]] = {
        name: (recording_figures.one_run(dataset, run, odometry, known.get(run.id), walls[run.id]),)
        for name, run in runs.items()
    }
    wheels: dict[str, tuple[blocks.Block, ...]] = {
        name: (recording_figures.wheel_rates(run, dataset.robot),) for name, run in runs.items()
    }
    exactness: tuple[str, ...] = ()
    if plan is not None and not all(run.id in begun for run in runs.values()):
        exactness = (
            f"The floor plan ({plan.name}) is drawn from the robot's mark; for a run that began beside the mark it is "
            "shifted by that distance.",
        )
    return [
        blocks.Section(f"{prefix}player", "Step by step", (player(dataset, runs, odometry, known, walls),)),
        blocks.Section(f"{prefix}wheels", "Wheel rates", (blocks.Choice("Run", wheels),)),
        blocks.Section(
            f"{prefix}room",
            "Runs in their room" if dataset.scans is not None else "Single runs",
            (blocks.Callout("Floor plan", exactness), blocks.Choice("Run", rooms)),
        ),
    ]


def _outlines(plan: RoomPlan | None, start: Array | None) -> list[Array]:
    """The walls of a floor plan relative to a start pose (3,) in it (default: its own), closed (n, 2) each, m."""
    if plan is None:
        return []
    return [seen_from(plan.start if start is None else start, outline) for outline in plan.outlines]
