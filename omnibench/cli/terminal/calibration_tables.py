"""Output of ``calibrate``, ``evaluate`` and ``certify``: a matrix, its errors on a data set, a proven bound."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.table import Table

from omnibench.fit.calibrate import CalibrationRun
from omnibench.fit.certify import CertifiedCalibration
from omnibench.fit.evaluate import Evaluation
from omnibench.fit.parameterisation import WheelGeometry
from omnibench.fit.uncertainty.bootstrap import ElementIntervals
from omnibench.fit.uncertainty.physical import ParameterEstimate
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Robot
from omnibench.words import plural


def print_certificate(console: Console, certified: CertifiedCalibration) -> None:
    """Print a calibration's cost, its proven lower bound and what that means."""
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
    ended = "" if proof.finished else "; with more (--seconds, --parts) the bound may rise"
    console.print(
        f"{plural(proof.boxes, 'part')} of the box examined in {certificate.seconds:.1f} s{ended}", soft_wrap=True
    )


def print_calibration(console: Console, run: CalibrationRun) -> None:
    """Print the matrix beside its deviation from the design, its intervals, if any, and how the search ended."""
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
        f"{result.outcome}: {result.reason}; {plural(result.evaluations, 'evaluation')}, {result.seconds:.2f} s",
        soft_wrap=True,
    )


def _intervals(run: CalibrationRun) -> Iterator[tuple[str, ElementIntervals]]:
    if run.uncertainty is not None:
        yield "95 %", run.uncertainty.intervals
    if run.intervals is not None:
        yield "95 %, bootstrap", run.intervals


def _noise_in_words(noise: Noise) -> str:
    """White noise, random walk and bias of a run: those of positions, then those of headings."""
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
        interval = "not identified by these data"
        if parameter.low is not None and parameter.high is not None:
            interval = f"{form.format(factor * parameter.low)} .. {form.format(factor * parameter.high)}"
        table.add_row(parameter.name, *shown, deviation, interval)
    console.print(table)


def print_evaluation(console: Console, evaluation: Evaluation) -> None:
    """Print cost and final errors on every split, beside those of the design values."""
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


def _deviation(value: float, design: float) -> str:
    return f"{100 * (value / design - 1):+.2f} %" if design else "design 0"
