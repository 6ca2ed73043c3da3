"""The report of a calibration, by ``calibrate`` or ``evaluate``: before and after, paths, parameters, errors by motion.

Its table of parameters is the terminal's, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.evaluate import final_errors, positions_and_headings
from omnibench.fit.path_errors import PathError, predicted_errors
from omnibench.report import blocks as page
from omnibench.report.figures import marks
from omnibench.report.numbers import NOTHING, fixed, percent, significant, typeset
from omnibench.report.path_pictures import CALIBRATED, DESIGN_ITEM, Models, paths_before_after
from omnibench.report.style import plot
from omnibench.robot.calibration import Calibration, HeldOutVerdict
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_CALIBRATED = page.LegendItem("calibrated", "calibration", CALIBRATED)
_TURNS = 0.35  # rad: a run that turns less in all is straight; chosen
_ON_THE_SPOT = 0.5  # m a radian: a run that drives less turns on the spot, as seen from the wheels' reach; chosen
_HEADING = 24  # letters of a title that is the heading of a column
_INTERVAL_WIDTH = 22  # px that the plot of a parameter takes


def calibration_document(
    calibration: Calibration, dataset: Dataset, verdict: HeldOutVerdict, warnings: Sequence[str] = ()
) -> page.Document:
    """The report of a calibration on the runs of a data set: on those that the verdict is of, or else on all.

    DataError: a recording lacks what an effect of the calibration needs.
    """
    judged = [run for run in dataset.trajectories if run.id in set(verdict.runs)]
    runs, which = (judged, "held-out") if judged else (list(dataset.trajectories), "recorded")
    design = OdometryModel.of_design(dataset.robot, calibration.integration)
    models: Models = ((DESIGN_ITEM, design), (_CALIBRATED, calibration.model))
    errors = [final_errors(model, runs) for _, model in models]
    by_motion = _by_motion(runs, errors)
    parameters = tuple(calibration.physical_parameters.values())
    of_robot = [page.Section("parameters", "Radii, lengths and angles", (parameter_table(calibration),))]
    if any(each.low is not None for each in parameters):
        changes = (page.FigureGrid((_changes(calibration),), (_CALIBRATED,), 1, "", "parameters"), *of_robot[0].blocks)
        of_robot = [page.Section("parameters", "Radii, lengths and angles", changes)]
    return page.Document(
        title=f"Calibration of {dataset.robot.name}",
        subtitle=f"{calibration.name}, on {plural(len(runs), f'{which} run')} of {dataset.name}",
        sections=(
            page.answer_section(
                typeset(f"{verdict.sentence}."),
                _tiles(errors, verdict),
                paths_before_after(runs, models, which),
                page.Callout("What these data leave open", tuple(map(typeset, warnings)), "warning"),
            ),
            *(of_robot if parameters else ()),
            page.Section(
                "motions",
                "Errors by motion",
                (_motion_figure(by_motion), _motion_table(by_motion)),
                about=f"Errors of the final pose of the {which} runs, by what the robot drove.",
            ),
            *_paths(calibration),
            page.Section("matrix", "The matrix", (_matrix_table(calibration),), folded=True, about="What is computed."),
            page.Section(
                "origin", "How it was made", (_facts(calibration, verdict),), folded=True, about="Data, fit, versions."
            ),
        ),
        badges=page.simulated_badge(dataset.simulated),
    )


def _paths(calibration: Calibration) -> tuple[page.Section, ...]:
    """What the robot will do on usual paths; nothing where no covariance tells."""
    errors = predicted_errors(calibration)
    about = "Expected errors at the end, from the calibration's uncertainty and the slip that its runs showed."
    table = path_table(errors, calibration)
    return (page.Section("paths", "What to expect on other paths", (table,), about=about),) if errors else ()


def parameter_table(calibration: Calibration, title: str = "") -> page.Table:
    """The physical parameters beside the design: angles in degrees, and differences from the design in % or degrees."""
    rows = []
    for each in calibration.physical_parameters.values():
        factor, decimals, unit = {"rad": (math.degrees(1.0), 3, "deg"), "1": (1.0, 4, "")}.get(
            each.unit, (1.0, 5, each.unit)
        )
        share = None if each.unit == "rad" else each.deviation_percent
        change = f"{factor * each.deviation:+.{decimals}f} {unit}" if share is None else f"{share:+.2f} %"
        ends = [] if each.low is None or each.high is None else [each.low, each.high]
        interval = " to ".join(f"{factor * end:.{decimals}f}" for end in ends) or NOTHING
        values = (f"{factor * value:.{decimals}f}" for value in (each.design, each.value))
        rows.append(page.Row.of(each.name, *values, unit, change, interval))
    headings = (
        page.Column("design"),
        page.Column("value"),
        page.Column("", numeric=False),
        page.Column("change"),
        page.Column("95 %"),
    )
    heading = title.replace(" ", "\N{NO-BREAK SPACE}") if 0 < len(title) <= _HEADING else "parameter"
    caption = title if len(title) > _HEADING else ""
    return page.Table(caption, (page.Column(heading, numeric=False), *headings), tuple(rows))


def path_table(errors: Sequence[PathError], calibration: Calibration) -> page.Table:
    """The errors to expect at the ends of paths, by the design and by the calibration, with what holds 95 % of them."""
    rows = []
    for path in dict.fromkeys(error.path for error in errors):
        by_model = {error.model: error for error in errors if error.path == path}
        both = (by_model["design"], by_model["calibration"])
        places = (f"{_figures(1e3 * each.position_m)} ({_figures(1e3 * each.position_95_m)})" for each in both)
        turns = (f"{math.degrees(each.heading_rad):.2f} ({math.degrees(each.heading_95_rad):.2f})" for each in both)
        rows.append(page.Row.of(path, *places, *turns))
    columns = (
        page.Column("path", numeric=False),
        *(page.Column(f"position, {model}", "mm") for model in ("design", "calibration")),
        *(page.Column(f"heading, {model}", "deg") for model in ("design", "calibration")),
    )
    runs = "" if calibration.slip is None else f"; slip as of {plural(calibration.slip.runs, 'training run')}"
    return page.Table(f"errors to expect at a path's end (95 % lie within){runs}", columns, tuple(rows))


def _figures(value: float) -> str:
    """A number with two figures, or all before its point."""
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def _tiles(errors: Sequence[Array], verdict: HeldOutVerdict) -> tuple[page.Fact, ...]:
    """Mean final errors before and after, and the improvement."""
    (before, turned_before), (after, turned_after) = (positions_and_headings(of_model) for of_model in errors)
    tiles = [
        page.Fact("Position", f"{_mm(before)} → {_mm(after)}", "mean error of the final pose"),
        page.Fact("Heading", f"{_degrees(turned_before)} → {_degrees(turned_after)}", "mean error of the final pose"),
    ]
    if verdict.improvement is not None:
        known = verdict.low is not None and verdict.high is not None
        interval = f"95 %: {percent(verdict.low)} to {percent(verdict.high)}" if known else "no interval: too few"
        tiles.append(page.Fact("Final error removed", percent(verdict.improvement), interval))
    return tuple(tiles)


def _mm(distances: Array) -> str:
    return f"{significant(1e3 * float(distances.mean()))} mm"


def _degrees(angles: Array) -> str:
    return f"{fixed(math.degrees(float(angles.mean())), 2)}°"


def _changes(calibration: Calibration) -> page.Figure:
    """Each parameter's change from the design with its interval: of lengths in %, of angles in degrees."""
    names, values, below, above = [], [], [], []
    for each in calibration.physical_parameters.values():
        share_of_design = each.unit == "m" and each.design
        if each.low is None or each.high is None or not (each.unit == "rad" or share_of_design):
            continue
        scale = math.degrees(1.0) if each.unit == "rad" else 100 / abs(each.design)
        names.append(f"{each.name} ({'°' if each.unit == 'rad' else '%'})")
        values.append(scale * (each.value - each.design))
        below.append(scale * (each.value - each.low))
        above.append(scale * (each.high - each.value))
    error = {"type": "data", "array": above, "arrayminus": below}
    dots = go.Scatter(x=values, y=names, mode="markers", marker={"color": CALIBRATED, "size": 9}, error_x=error)
    figure = plot(dots, x_title="change from the design: lengths in %, angles in degrees")
    figure.add_vline(x=0.0, line={"width": 1, "dash": "dot"})
    figure.update_yaxes(autorange="reversed", automargin=True)
    height = 130 + _INTERVAL_WIDTH * len(names)
    title = "Change from the design, with 95 % intervals"
    return page.Figure(title, figure, f"{title}: {', '.join(names)}", height)


def _by_motion(runs: Sequence[Trajectory], errors: Sequence[Array]) -> dict[str, list[Array]]:
    """Final errors (n, 3) of the design and of the calibration, by what the robot drove."""
    kinds = [_motion(run) for run in runs]
    known = ("straight", "turning left", "turning right", "both ways", "on the spot")
    names = [name for name in known if name in kinds]
    return {name: [of_model[np.array(kinds) == name] for of_model in errors] for name in names}


def _motion(run: Trajectory) -> str:
    """The kind of motion of a run, by its reference; by its references alone, or the wheels, it is not looked at."""
    steps = np.diff(run.poses, axis=0)
    way, turn = float(np.hypot(*steps[:, :2].T).sum()), steps[:, 2]
    turned = float(np.abs(turn).sum())
    if turned < _TURNS:
        return "straight"
    if way < _ON_THE_SPOT * turned / (2 * math.pi):
        return "on the spot"
    left = float(turn[turn > 0].sum()) / turned
    return "turning left" if left > 0.8 else "turning right" if left < 0.2 else "both ways"


def _motion_figure(by_motion: dict[str, list[Array]]) -> page.FigureGrid:
    """Every run's final error, position and heading, by motion: a dot each before and after."""
    figures = []
    for title, unit, index in (("Position error of the final pose", "mm", 0), ("Heading error", "degrees", 1)):
        traces, names = [], list(by_motion)
        for model, item in enumerate((DESIGN_ITEM, _CALIBRATED)):
            x, y = list[float](), list[float]()
            for number, of_kind in enumerate(by_motion.values()):
                values = positions_and_headings(of_kind[model])[index]
                scaled = 1e3 * values if index == 0 else np.degrees(values)
                spread = np.linspace(-0.12, 0.12, len(scaled)) if len(scaled) > 1 else np.zeros(1)
                x += (number + 0.32 * (model - 0.5) + spread).tolist()
                y += scaled.tolist()
            traces.append(marks(item, 6, np.array(x), np.array(y), hover=f"%{{y:.3g}} {unit}", marker_opacity=0.6))
        figure = plot(*traces, y_title=unit)
        figure.update_xaxes(tickvals=list(range(len(names))), ticktext=names, range=[-0.5, len(names) - 0.5])
        figure.update_yaxes(rangemode="tozero")
        figures.append(page.Figure(title, figure, f"{title} of every run, by motion, before and after", 320))
    return page.FigureGrid(tuple(figures), (DESIGN_ITEM, _CALIBRATED), 2, "", "errors-by-motion")


def _motion_table(by_motion: dict[str, list[Array]]) -> page.Table:
    rows = []
    for name, of_kind in by_motion.items():
        both = [positions_and_headings(errors) for errors in of_kind]
        rows.append(
            page.Row.of(
                name, str(len(of_kind[0])), *(_mm(each[0]) for each in both), *(_degrees(each[1]) for each in both)
            )
        )
    columns = (
        page.Column("motion", numeric=False),
        page.Column("runs"),
        *(page.Column(f"position, {which}") for which in ("design", "calibration")),
        *(page.Column(f"heading, {which}") for which in ("design", "calibration")),
    )
    return page.Table("Mean errors of the final pose", columns, tuple(rows))


def _matrix_table(calibration: Calibration) -> page.Table:
    rows = [
        page.Row.of(label, *(f"{value:+.7f}" for value in row))
        for label, row in zip(("x (m/rad)", "y (m/rad)", "heading (rad/rad)"), calibration.matrix, strict=True)
    ]
    columns = (page.Column("row", numeric=False), *map(page.Column, calibration.robot.drive.names))
    note = f"Effects beside it: {calibration.effects_in_words}." if calibration.effects else ""
    return page.Table("Inverse kinematic matrix", columns, tuple(rows), note)


def _facts(calibration: Calibration, verdict: HeldOutVerdict) -> page.Facts:
    """Where the calibration comes from, and how to make it again."""
    origin = calibration.provenance
    facts = [page.Fact("Verdict", typeset(verdict.sentence), typeset(verdict.detail))]
    if origin is not None:
        options = ", ".join(f"{name} {value}" for name, value in origin.options.items())
        facts += [
            page.Fact("Fitted to", origin.dataset, f"hash {origin.dataset_hash}"),
            page.Fact("Calibrator", origin.calibrator, options),
            page.Fact("Outcome", origin.outcome, typeset(origin.reason)),
            page.Fact("Versions", ", ".join(f"{name} {version}" for name, version in origin.versions.items())),
        ]
    return page.Facts(tuple(facts))
