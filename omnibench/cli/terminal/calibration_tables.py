"""Output of ``calibrate``, ``evaluate`` and ``certify``: a matrix, its errors on a data set, a proven bound."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console, RenderableType

from omnibench.cli.terminal.console import print_ending
from omnibench.cli.terminal.tables import print_table, render_table
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun
from omnibench.fit.certify import QUADRATURE, CertifiedCalibration
from omnibench.fit.evaluate import Evaluation
from omnibench.fit.path_errors import PathError
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.calibration_report import parameter_table, path_table
from omnibench.report.numbers import noise_in_words
from omnibench.robot.calibration import Calibration, HeldOutVerdict
from omnibench.robot.export.formats import export_calibration, left_out
from omnibench.robot.kinematics import relative_deviations
from omnibench.words import kind_of_data, plural

_NONE = "no interval"
_SCREEN = 25  # lines that a command prints at most, so that a terminal shows all
_ROWS = ("x (m/rad)", "y (m/rad)", "w (rad/rad)")
_NOTHING_TO_GAIN = 0.01  # share of the cost that is not worth another search; chosen
_COLUMNS = 3  # columns with an interval each that 80 columns of a terminal hold
_TOUCHED = 1e-6  # share of a direction of drive signals: a smaller one is rounding


def print_certificate(console: Console, certified: CertifiedCalibration) -> None:
    """Print a calibration's cost, its proven lower bound and what that means."""
    certificate, proof = certified.certificate, certified.proof
    kind = kind_of_data(certified.dataset.simulated)
    lines = [f"{certified.dataset.name} ({kind}), training split, cost {certified.cost_name}"]
    lines.append(f"cost of the calibration      {certificate.cost * (1 + (certificate.shrinking or 0.0)):.9f}")
    if certificate.shrinking is not None:
        lines.append(f"optimum of the matrix alone  {certificate.cost:.9f}")
        differs = f"its cost differs by {certificate.shrinking:+.2%}."
        lines.append(f"The calibration weighs the design, or has effects: {differs}")
    if proof.best_cost < certificate.cost:
        lines.append(f"best matrix seen in the box  {proof.best_cost:.9f}")
    lines.append(f"proven lower bound           {certificate.lower_bound:.9f}")
    if certificate.cost < QUADRATURE:
        lines.append(f"There is nothing to gain: what is left is rounding (below {QUADRATURE:g}).")
    else:
        lines.append(
            f"No matrix in the box {certificate.box!r} costs less than that: whatever the optimiser, there is at most "
            f"{max(certificate.gap, 0.0):.3%} to gain on this calibration."
        )
    if certified.held:
        lines.append(f"The box holds {', '.join(certified.held)} at the design value.")
    ended = "" if proof.finished else "; with more (--seconds, --parts) the bound may rise"
    lines.append(f"{plural(proof.boxes, 'part')} of the box examined in {certificate.seconds:.1f} s{ended}")
    for line in lines:
        console.print(line, soft_wrap=True)


def print_calibration(console: Console, run: CalibrationRun, others: Sequence[str] = (), last: str = "") -> bool:
    """Print the physical parameters, then the matrix, then what the intervals rest on, as far as a screen holds it.

    others: what the command prints as well. Returns whether there is room for the line ``last``, too.
    """
    lines = [f"{run.result.outcome}: {run.result.reason}; {plural(run.result.evaluations, 'evaluation')}"]
    lines[0] += f", {run.result.seconds:.2f} s"
    if run.uncertainty is not None:
        lines.insert(0, f"95 % intervals: {run.uncertainty.source}")
        if run.calibration.noise is not None:
            lines.append(f"noise of the reference: {'; '.join(noise_in_words(run.calibration.noise))}")
    room = _SCREEN - _height(console, *others)
    if run.parameters:
        parameters = render_table(parameter_table(run.calibration, _title(run)), console.width)
        console.print(parameters)
        room -= _height(console, parameters)

    # The matrix with its intervals, if all else has room then; without; its elements alone; or where it is.
    calibration, names = run.calibration, run.calibration.robot.drive.names
    tables = [render_table(_matrix_table(run, intervals=shown), console.width) for shown in (True, False)]
    forms = [(tables[0], lines), (tables[1], [])]
    width = max(11, *(len(name) + 1 for name in names))
    elements = [f"{'matrix':12}{''.join(f'{name:>{width}}' for name in names)}"]
    for label, row in zip(_ROWS, calibration.matrix, strict=True):
        elements.append(f"{label:12}{''.join(f'{value:+{width}.7f}' for value in row)}")
    if max(map(len, elements)) <= console.width:
        forms.append(("\n".join(elements), []))
    place = f"matrix (3 x {len(names)}): not on this screen; --json shows it, -o writes it"
    matrix = next((form for form, rest in forms if _height(console, form, *rest) <= room), place)
    console.print(matrix, soft_wrap=isinstance(matrix, str))
    room -= _height(console, matrix)
    for line in lines:
        if _height(console, line) <= room:
            console.print(line, soft_wrap=True)
            room -= _height(console, line)
    return _height(console, last) <= room


def _height(console: Console, *shown: RenderableType) -> int:
    """The lines that this takes on a console, in a pipe that does not wrap texts."""
    texts = [each.splitlines() for each in shown if isinstance(each, str)]
    tables = [len(console.render_lines(each)) for each in shown if not isinstance(each, str)]
    width = console.width if console.is_terminal else sys.maxsize
    return sum(tables) + sum(-(-max(len(line), 1) // width) for text in texts for line in text)


def _title(run: CalibrationRun) -> str:
    provenance = run.calibration.provenance
    return f"{run.calibration.name}{' (simulated data)' if provenance is not None and provenance.simulated else ''}"


def _matrix_table(run: CalibrationRun, intervals: bool) -> Table:
    """The matrix with its deviation from the design values, each row perhaps followed by its intervals.

    It has a column for each drive signal; of more than three it is turned, so that a terminal shows all.
    """
    calibration, drive = run.calibration, run.calibration.robot.drive
    elements = run.uncertainty.intervals if run.uncertainty is not None and intervals else None
    notes = []
    if run.kept:
        motions = " and ".join(f"{each.words} ({each.motion})" for each in run.kept)
        only = f"* only if the design values are right along {motions}: these data say nothing of it, and they are kept"
        without = f"the design values are kept along {motions}, of which these data say nothing"
        notes.append(without if elements is None else only)
    if elements is not None and (stopped := [*run.untouched, *run.result.at_bounds]):
        notes.append(f"{_NONE} of what rests on {', '.join(stopped)}, held by the box or on a bound of it")
    deviations = relative_deviations(calibration.matrix_array, calibration.robot.inverse_kinematic_matrix)
    values = [
        [Cell(f"{value:+.7f}", _deviation(share)) for value, share in zip(*of_row, strict=True)]
        for of_row in zip(calibration.matrix, deviations, strict=True)
    ]
    labelled = [("", values)]
    if elements is not None:
        touched = np.any([np.zeros(len(drive.names)), *(np.abs(each.rates) > _TOUCHED for each in run.kept)], axis=0)
        marks = ["*" if touch else "" for touch in touched]
        bounds = [
            [Cell("", _interval(*each)) for each in zip(*of_row, marks, strict=True)]
            for of_row in zip(elements.low, elements.high, strict=True)
        ]
        labelled.append(("  95 %", bounds))
    headings: Sequence[str] = [f"wheel {name}" if drive.direct else name for name in drive.names]
    labels: Sequence[str] = _ROWS
    if len(headings) > _COLUMNS:
        headings, labels = labels, headings
        labelled = [(name, [list(column) for column in zip(*cells, strict=True)]) for name, cells in labelled]
    rows = [Row.of(name or label, *cells[n]) for n, label in enumerate(labels) for name, cells in labelled]
    columns = (Column("matrix", numeric=False), *map(Column, headings))
    return Table("" if run.parameters else _title(run), columns, tuple(rows), "; ".join(notes))


def _interval(low: float, high: float, mark: str) -> str:
    if low == high:
        return "by design"  # fixed wheels keep the robot from moving sideways
    return _NONE if math.isnan(low) else f"{low:+.7f} to {high:+.7f}{mark}"


def print_evaluation(console: Console, evaluation: Evaluation) -> None:
    """Print cost and final errors on every split, beside those of the design values."""
    rows = []
    for split in evaluation.splits:
        if split == "all" and len(evaluation.splits) > 2:  # the lines above say it
            continue
        title = f"{split}: {plural(evaluation.splits[split].trajectories, 'run')}"
        if evaluation.unfitted is not None:
            part, whole = evaluation.unfitted[split], evaluation.splits[split].trajectories
            held_out = {0: "none", whole: "all"}.get(part, f"{part:,}")
            title += f", {held_out} held out"
        if (outside := evaluation.splits[split].outside) is not None:
            title += f", {100 * outside:.0f} % of the time outside of what it was fitted to"
        rows.append(Row.of(title, role="group"))
        for label, errors in (("calibration", evaluation.splits[split]), ("design", evaluation.design[split])):
            position = (
                "" if each is None else f"{each:.4f}" for each in (errors.position_mean_m, errors.position_max_m)
            )
            angles = (errors.heading_mean_rad, errors.heading_max_rad)
            heading = ("" if each is None else f"{math.degrees(each):.2f}" for each in angles)
            rows.append(Row.of(label, f"{errors.cost:.4f}", *position, *heading))
    columns = (
        Column("model", numeric=False),
        Column("error, Eq. (6)"),
        *(Column(f"position, {which}", "m") for which in ("mean", "max")),
        *(Column(f"heading, {which}", "deg") for which in ("mean", "max")),
    )
    kind = " (simulated data)" if evaluation.simulated else ""
    note = f"fitted with the loss {evaluation.loss}; the errors are without it" if evaluation.loss else ""
    print_table(console, Table(f"{evaluation.dataset}{kind}", columns, tuple(rows), note))
    # The errors at references other than poses, by kind.
    rows = []
    for split, errors in evaluation.splits.items():
        rows += [Row.of(split, role="group")] if errors.references else []
        for fitted, before in zip(errors.references, evaluation.design[split].references, strict=True):
            sizes = (
                _size(each, of_model.unit) for of_model in (fitted, before) for each in (of_model.mean, of_model.max)
            )
            ratios = (f"{fitted.in_sigmas:.1f}", f"{before.in_sigmas:.1f}")
            rows.append(Row.of(fitted.kind, str(fitted.references), *sizes, *ratios))
    headings = (
        Column("reference", numeric=False),
        Column("number"),
        Column("mean"),
        Column("largest", priority=1),
        Column("design: mean"),
        Column("largest", priority=1),
        Column("in sigmas"),
        Column("design: in sigmas", priority=1),
    )
    if rows:
        note = (
            "in sigmas: root mean square of errors in the references' own standard deviations, 1 if the model is right"
        )
        print_table(console, Table("errors by kind of reference", headings, tuple(rows), note))


def print_path_errors(console: Console, errors: Sequence[PathError], calibration: Calibration) -> None:
    """Print the errors to expect at the ends of paths, with what holds 95 % of them; nothing where there are none."""
    if errors:
        print_table(console, path_table(errors, calibration))


def _size(value: float, unit: str) -> str:
    return f"{math.degrees(value):.2f} deg" if unit == "rad" else f"{1000 * value:.1f} mm"


def print_verdict_ending(
    verdict: HeldOutVerdict, calibration: Calibration, file: Path, datasets: Sequence[Path]
) -> None:
    """Print the last sentence of ``calibrate`` and ``evaluate``: use a calibration, record more, or look for faults."""
    if verdict.verdict == "better":
        basis = "on runs that were held out" if verdict.basis == "held_out" else "by cross-validation"
        print_ending(f"{file} is better than the design {basis}", *how_to_use(calibration, file))
    elif verdict.verdict == "worse":
        look = ("omnibench", "inspect", *datasets)
        print_ending(f"{file} is worse than the design: do not use it", "see what the recordings lack", *look)
    elif verdict.verdict == "undecided":
        more = "record more runs for validation; what these tell"
        print_ending(f"whether {file} is better than the design is open", more, "omnibench", "inspect", *datasets)
    else:
        other = ("omnibench", "evaluate", file, "DATASET")
        print_ending(f"{file} was not judged by other runs", "try it on a recording that it was not fitted to", *other)


def how_to_use(calibration: Calibration, file: Path) -> tuple[str, ...]:
    """The next step with a calibration in words, then the words to type: an export, or a node if none holds it."""
    if calibration.plain is None and left_out(calibration):
        return "name it in the config of a live node, which alone has its effects", "omnibench", "guide", "live"
    # The format to try first: parameters of a ROS 2 controller where one suits the robot.
    export_format = "ros2_controllers"
    try:
        export_calibration(calibration, export_format)
    except ConfigError:
        export_format = "c_header"
    return "use it on the robot", "omnibench", "export", str(file), "--to", export_format


def print_certificate_ending(certified: CertifiedCalibration, file: Path, datasets: Sequence[Path]) -> None:
    """Print the last sentence of ``certify``: whether a better search is worth the time."""
    gap = max(certified.certificate.gap, 0.0)
    if gap <= _NOTHING_TO_GAIN:
        found = ("omnibench", "discover", *datasets, "--model", file)
        print_ending(f"no search can gain more than {gap:.2%} on {file}", "look for what a matrix lacks", *found)
    elif not certified.proof.finished:
        longer = ("omnibench", "certify", file, *datasets, "--seconds", "600")
        print_ending(f"a better matrix may save up to {gap:.1%} of the cost", "prove more, with more time", *longer)
    else:
        exact = ("omnibench", "calibrate", *datasets, "-o", "better.yaml")
        print_ending(f"a better matrix may save up to {gap:.1%} of the cost", "search for it", *exact)


def _deviation(share: float) -> str:
    return "design 0" if math.isnan(share) else f"{100 * share:+.2f} %"
