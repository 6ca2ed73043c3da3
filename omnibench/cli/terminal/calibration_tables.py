"""What the command line prints besides tables of a comparison."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from omnibench.fit.calibrate import CalibrationRun
from omnibench.fit.certify import CertifiedCalibration, Proof
from omnibench.fit.evaluate import Evaluation
from omnibench.fit.inspect import Inspection, ScansContent
from omnibench.fit.parameterisation import WheelGeometry
from omnibench.fit.uncertainty.bootstrap import ElementIntervals
from omnibench.fit.uncertainty.identifiability import ROWS, Identifiability
from omnibench.fit.uncertainty.physical import ParameterEstimate
from omnibench.registry import REGISTRIES, Entry, PluginFailure
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Robot

_PIPED_WIDTH = 160


def make_console(error: bool = False) -> Console:
    """A console that shows texts as they are, and does not squeeze tables into 80 columns when it is piped."""
    stream = sys.stderr if error else sys.stdout
    width = None if stream.isatty() else _PIPED_WIDTH
    return Console(file=stream, width=width, markup=False, emoji=False, highlight=False)


class EvaluationsBar:
    """A bar of evaluations for one calibrator, on a terminal."""

    def __init__(self, title: str, evaluations: int) -> None:
        console = make_console(error=True)
        self._progress = Progress(
            TextColumn(title),
            BarColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=evaluations, note="")

    def __enter__(self) -> EvaluationsBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, evaluations: int, best: float) -> None:
        self._progress.update(self._task, completed=evaluations, note=f"{evaluations} evaluations, best {best:.6f}")


class Steps:
    """What is under way and how far it is: a bar for each stage on a terminal, a line for each where it is piped."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Steps:
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        if what not in self._tasks:
            self._progress.start()  # only now is there something to show
            self._tasks[what] = self._progress.add_task(what, total=total)
            if not self._console.is_terminal:
                self._console.print(f"{what}: {total}", soft_wrap=True)
        self._progress.update(self._tasks[what], completed=done)


class ProofLine:
    """How far a proof has come, on a terminal."""

    def __init__(self) -> None:
        console = make_console(error=True)
        self._progress = Progress(
            TextColumn("proving"),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=None, note="")

    def __enter__(self) -> ProofLine:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, proof: Proof) -> None:
        note = f"{proof.boxes} parts of the box, bound {proof.lower_bound:.6f}, best {proof.best_cost:.6f}"
        self._progress.update(self._task, note=note)


def print_certificate(console: Console, certified: CertifiedCalibration) -> None:
    """What is proven of a calibration, in words."""
    certificate, proof = certified.certificate, certified.proof
    kind = "simulated data" if certified.dataset.simulated else "recorded data"
    console.print(f"{certified.dataset.name} ({kind}), training split, cost {certified.cost_name}", soft_wrap=True)
    console.print(f"cost of the calibration      {certificate.cost:.9f}")
    if proof.best_cost < certificate.cost:
        console.print(f"best matrix seen in the box  {proof.best_cost:.9f}")
    console.print(f"proven lower bound           {certificate.lower_bound:.9f}")
    console.print(
        f"No matrix in the box {certificate.box!r} costs less than that: whatever the optimiser, there is at most "
        f"{max(certificate.gap, 0.0):.3%} to gain on this calibration.",
        soft_wrap=True,
    )
    if certified.held:
        console.print(f"The box holds {', '.join(certified.held)} at the design value.", soft_wrap=True)
    ended = "" if proof.finished else "; the time was up: with more (--seconds) the bound may rise"
    console.print(f"{proof.boxes} parts of the box looked at in {certificate.seconds:.1f} s{ended}", soft_wrap=True)


def print_calibration(console: Console, run: CalibrationRun) -> None:
    """The matrix, its deviation from the design, its intervals if there are any, and how it was found."""
    calibration, result = run.calibration, run.result
    design = calibration.robot.inverse_kinematic_matrix
    simulated = calibration.provenance is not None and calibration.provenance.simulated
    table = Table(title=f"{calibration.name}{' (simulated data)' if simulated else ''}", title_justify="left")
    table.add_column("")
    for wheel in calibration.robot.wheel_names:
        table.add_column(f"wheel {wheel}", justify="right")
    labels = zip("xyw", ("m/rad", "m/rad", "rad/rad"), strict=True)
    rows = zip(labels, calibration.matrix, design, strict=True)
    for row_number, ((label, unit), row, start) in enumerate(rows):
        cells = [f"{value:+.7f} ({_deviation(value, first)})" for value, first in zip(row, start, strict=True)]
        table.add_row(f"{label} ({unit})", *cells)
        for label, intervals in _intervals(run):
            bounds = zip(intervals.low[row_number], intervals.high[row_number], strict=True)
            table.add_row(f"  {label}", *(f"{low:+.7f} .. {high:+.7f}" for low, high in bounds), style="dim")
    console.print(table)
    if run.uncertainty is not None and run.uncertainty.parameters is not None:
        _print_parameters(console, calibration.robot, run.uncertainty.parameters)
    if run.uncertainty is not None:
        console.print(f"95 % intervals: {run.uncertainty.source}", soft_wrap=True)
        console.print(f"noise of the reference: {_noise_in_words(run.uncertainty.noise)}", soft_wrap=True)
    console.print(
        f"{result.outcome}: {result.reason}; {result.evaluations} evaluations, {result.seconds:.2f} s",
        soft_wrap=True,
    )


def _intervals(run: CalibrationRun) -> Iterator[tuple[str, ElementIntervals]]:
    if run.uncertainty is not None:
        yield "95 %", run.uncertainty.intervals
    if run.intervals is not None:
        yield "95 %, bootstrap", run.intervals


def _noise_in_words(noise: Noise) -> str:
    """Positions and headings apart, without what is zero."""
    kinds = (("white", ""), ("walk", "/sqrt s"), ("bias of a run", ""))
    position = (noise.pose_position, noise.walk_position, noise.bias_position)
    heading = (noise.pose_heading, noise.walk_heading, noise.bias_heading)
    parts = [
        ", ".join(f"{kind} {factor * value:.2g} {unit}{per}" for (kind, per), value in zip(kinds, values, strict=True))
        for values, factor, unit in ((position, 1000.0, "mm"), (heading, math.degrees(1.0), "deg"))
    ]
    return "; ".join(parts)


def _print_parameters(console: Console, robot: Robot, parameters: Sequence[ParameterEstimate]) -> None:
    table = Table(title="physical parameters", title_justify="left")
    for heading in ("parameter", "design", "fitted", "deviation", "95 %"):
        table.add_column(heading, justify="left" if heading == "parameter" else "right")
    design = WheelGeometry(robot).start
    for parameter, start in zip(parameters, design, strict=True):
        factor, form = (math.degrees(1.0), "{:.3f} deg") if parameter.unit == "rad" else (1.0, "{:.5f} m")
        shown = [form.format(factor * value) for value in (start, parameter.value)]
        deviation = "design 0" if not start else f"{100 * (parameter.value / start - 1):+.2f} %"
        interval = "not told by these data"
        if parameter.low is not None and parameter.high is not None:
            interval = f"{form.format(factor * parameter.low)} .. {form.format(factor * parameter.high)}"
        table.add_row(parameter.name, *shown, deviation, interval)
    console.print(table)


def print_evaluation(console: Console, evaluation: Evaluation) -> None:
    """Cost and final errors on every split, with the design values for comparison."""
    kind = " (simulated data)" if evaluation.simulated else ""
    table = Table(title=f"{evaluation.dataset}{kind}", title_justify="left")
    table.add_column("split")
    table.add_column("model")
    for heading in ("runs", "cost (Eq. 6)", "position mean", "max", "heading mean", "max"):
        table.add_column(heading, justify="right")
    for split in evaluation.splits:
        for label, errors in (("calibration", evaluation.splits[split]), ("design", evaluation.design[split])):
            table.add_row(
                split,
                label,
                str(errors.trajectories),
                f"{errors.cost:.4f}",
                f"{errors.position_mean_m:.4f} m",
                f"{errors.position_max_m:.4f} m",
                f"{math.degrees(errors.heading_mean_rad):.2f} deg",
                f"{math.degrees(errors.heading_max_rad):.2f} deg",
            )
    console.print(table)


def print_inspection(console: Console, found: Inspection) -> None:
    """A data set in a table and its findings in words."""
    kind = "simulated data" if found.simulated else "recorded data"
    described = f"; {found.description}" if found.description else ""
    console.print(f"{found.dataset}: {kind}{described}", soft_wrap=True)
    for label, text in (("source", found.source), ("licence", found.licence)):
        if text:
            console.print(f"{label}: {text}", soft_wrap=True)
    shortest, longest = (1000 * period for period in found.sample_period_range_s)
    console.print(
        f"robot {found.robot}, wheels {', '.join(found.wheels)}; {found.wheel_samples} wheel samples every "
        f"{1000 * found.sample_period_s:g} ms ({shortest:.3g} to {longest:.3g} ms), {found.reference_poses} reference "
        f"poses every {1000 * found.pose_period_s:.3g} ms",
        soft_wrap=True,
    )
    if found.scans is not None:
        _print_scans(console, found.scans)
    table = Table()
    for heading in ("split", "runs", "commands", "repetitions", "sessions", "duration", "distance", "turned"):
        table.add_column(heading, justify="left" if heading == "split" else "right")
    for name, split in found.splits.items():
        repetitions = f"{split.repetitions_min}"
        if split.repetitions_max != split.repetitions_min:
            repetitions += f" to {split.repetitions_max}"
        table.add_row(
            name,
            str(split.trajectories),
            str(split.commands),
            repetitions,
            str(split.sessions),
            f"{split.duration_s:.0f} s",
            f"{split.distance_m:.1f} m",
            f"{math.degrees(split.turned_rad):.0f} deg",
        )
    console.print(table)
    shares = ", ".join(f"{share:.2g}" for share in found.driven_shares)
    console.print(f"directions of wheel rates driven: {found.driven_directions} of {len(found.wheels)} ({shares})")
    _print_identifiability(console, found.identifiability)
    for finding in found.findings:
        console.print(f"- {finding}", soft_wrap=True)


def _print_scans(console: Console, scans: ScansContent) -> None:
    every = "" if scans.scan_period_s is None else f" every {1000 * scans.scan_period_s:.3g} ms"
    console.print(
        f"{scans.scans} scans{every} in {scans.trajectories} runs; {scans.rays} rays over "
        f"{math.degrees(scans.field_of_view_rad):.0f} deg up to {scans.range_max_m:g} m, of which "
        f"{scans.seen_share:.0%} measured something",
        soft_wrap=True,
    )


def _print_identifiability(console: Console, told: Identifiability) -> None:
    table = Table(title="what a calibration can tell, +- % of the row's largest element", title_justify="left")
    for heading in ("wheel rates along", "which is", "driven", *(f"row {row}" for row in ROWS)):
        table.add_column(heading, justify="left" if heading in ("wheel rates along", "which is") else "right")
    for each in told.directions:
        deviations = ["open"] * len(ROWS)
        if each.state == "driven" and each.deviations is not None:
            deviations = [f"{100 * value:.2g} %" for value in each.deviations]
        table.add_row(each.direction, each.motion or "slip of the wheels", f"{100 * each.share:.3g} %", *deviations)
    console.print(table)
    console.print(f"noise: {told.noise_source}", soft_wrap=True)


def print_registries(console: Console) -> None:
    """Everything that a config can name."""
    for registry in REGISTRIES:
        entries = registry.entries()
        table = Table(title=f"{registry.kind}s", title_justify="left", title_style="bold", expand=False)
        for heading in ("name", "what", "from"):
            table.add_column(heading, overflow="fold")
        for entry in entries:
            table.add_row(entry.name, entry.summary, entry.origin)
        console.print(table if entries else f"{registry.kind}s: none yet")


def registry_document(failures: list[PluginFailure]) -> dict[str, object]:
    """Everything that a config can name, with options, as one JSON document."""

    def row(entry: Entry[object]) -> dict[str, object]:
        options = entry.options.model_json_schema().get("properties", {})
        return {"name": entry.name, "summary": entry.summary, "from": entry.origin, "options": options}

    document: dict[str, object] = {
        f"{registry.kind}s": [row(entry) for entry in registry.entries()] for registry in REGISTRIES
    }
    return document | {"failures": [{"from": failure.origin, "error": failure.error} for failure in failures]}


def _deviation(value: float, design: float) -> str:
    return f"{100 * (value / design - 1):+.2f} %" if design else "design 0"
