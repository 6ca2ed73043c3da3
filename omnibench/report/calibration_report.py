"""A calibration and an evaluation as they are shown: parameters, matrix, errors before and after, paths, motions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go
import polars as pl

from omnibench.data.dataset import Dataset
from omnibench.errors import ConfigError, DataError, require_type
from omnibench.fit.calibrate import CalibrationRun
from omnibench.fit.evaluate import Evaluation, ModelErrors, SplitErrors
from omnibench.fit.path_errors import PathError, predicted_errors
from omnibench.report import blocks as page
from omnibench.report.figures import drawn
from omnibench.report.numbers import NOTHING, fixed, noise_in_words, percent, significant, typeset
from omnibench.report.path_pictures import CALIBRATED, DESIGN_ITEM, Models, paths_before_after
from omnibench.report.recording.recording_figures import kinds_of
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import plot, text
from omnibench.robot.calibration import Calibration, HeldOutVerdict
from omnibench.robot.export.formats import export_calibration, left_out
from omnibench.robot.kinematics import relative_deviations
from omnibench.robot.model import OdometryModel
from omnibench.robot.physical import PhysicalParameter
from omnibench.words import plural

_CALIBRATED = page.LegendItem("calibrated", "calibration", CALIBRATED)
_ROWS = {"x": "m/rad", "y": "m/rad", "heading": "rad/rad"}
_SCREEN = 12  # rows of parameters and elements, of which a terminal of 25 lines holds all that is said; chosen
_TONES: Mapping[str, page.Tone] = {"better": "good", "worse": "bad", "undecided": "warning", "unknown": "plain"}
_FINAL = ("trajectories", "cost", "position_mean_m", "position_max_m", "heading_mean_rad", "heading_max_rad")
_MODELS: tuple[Literal["design", "calibration"], ...] = ("design", "calibration")
_UNITS = {"position": "mm", "heading": "deg"}
_NOT_JUDGED = HeldOutVerdict(verdict="unknown", sentence="not judged by other runs", detail="")


class CalibrationResult(Result):
    """A calibration or a run of ``calibrate``.

    file: where it was written, None if nowhere. sources: the data sets as they were typed. dataset: for the page.
    verdict: by held-out runs, by default that of its file. again: words that write it. box: that was searched.
    """

    def __init__(
        self,
        shown: Calibration | CalibrationRun,
        dataset: Dataset | None = None,
        verdict: HeldOutVerdict | None = None,
        file: Path | None = None,
        sources: Sequence[Path] = (),
        again: Sequence[str] = (),
        box: object = None,
    ) -> None:
        self.run = shown if isinstance(shown, CalibrationRun) else None
        self.calibration = shown.calibration if isinstance(shown, CalibrationRun) else shown
        self.dataset, self.file, self.sources, self.again = dataset, file, sources, again
        name, robot, origin = self.calibration.name, self.calibration.robot.name, self.calibration.provenance
        self.verdict = verdict or (None if origin is None else origin.held_out)
        try:
            self.parameters: Mapping[str, PhysicalParameter] = self.calibration.physical_parameters
        except DataError:  # no wheels near the design have this matrix
            self.parameters = {}
        fitted = "" if origin is None else f", fitted to {origin.dataset} by {origin.calibrator}"
        self.heading = f"{name}{' (simulated data)' if origin is not None and origin.simulated else ''}"
        self.title = f"{type(shown).__name__} {name!r} of robot {robot}{fitted}"
        # What the data and the search leave open
        warnings, in_box = list[str](), "box" if box is None else f"box {box!r}"
        if self.run is not None:
            warnings += [*(dataset.warnings if dataset else ()), *self.run.warnings]
            if bounds := ", ".join(self.run.result.at_bounds):
                warnings.append(f"on a bound of the {in_box}: {bounds}; a wider box may fit better")
            if untouched := ", ".join(self.run.untouched):
                warnings.append(f"not fitted, kept at the start value by the {in_box} or the cost: {untouched}")
        self.warnings = warnings

    def sentence(self) -> str:
        return "" if self.verdict is None else self.verdict.sentence

    def next_step(self) -> NextStep:
        if self.file is None:
            return NextStep("the calibration above is written nowhere", "write it to a file", tuple(self.again))
        if self.run is not None and self.run.result.at_bounds:
            what = f"{self.file} lies on a bound of what was searched: robot.yaml may be wrong, do not use it"
            return NextStep(what, "see what is", ("omnibench", "check", *self.sources))
        return next_step(self.calibration, self.verdict, self.file, self.sources)

    def tables(self) -> Sequence[page.Table]:
        """Parameters, and the elements of the matrix as far as a screen holds both."""
        if not self.parameters:
            return [self.elements()]
        tables = [parameter_table(self.calibration, self.heading), self.elements("matrix")]
        rows = sum(len(table.rows) for table in tables) + 2 * len(self.warnings)
        return tables if rows <= _SCREEN else tables[:1]

    def remarks(self) -> Sequence[Remark]:
        lines, run = list[str](), self.run
        if self.parameters and len(self.tables()) < 2:
            size = f"3 x {len(self.calibration.matrix[0])}"
            lines.append(f"matrix ({size}): not on this screen; --json shows it, -o writes it")
            lines += filter(None, [self._kept])
        if run is not None and run.uncertainty is not None:
            lines.append(f"95 % intervals: {run.uncertainty.source}")
        if run is not None and run.result.outcome != "converged":
            lines.append(f"{run.result.outcome}: {run.result.reason}")
        if self.file is not None:
            lines.append(f"calibration: {self.file}")
        return [*map(Remark, lines), *(verdict_remarks(self.verdict) if self.file or self.again else ())]

    def json(self) -> Calibration:
        return self.calibration

    def document(self) -> page.Document:
        assert self.dataset is not None
        warnings = self.run.warnings if self.run else ()
        return calibration_document(self.run or self.calibration, self.dataset, self.verdict or _NOT_JUDGED, warnings)

    def elements(self, heading: str = "") -> page.Table:
        """The elements of the matrix beside the design, with their intervals, as parameters are shown."""
        rows, design = [], self.calibration.robot.inverse_kinematic_matrix
        shares = relative_deviations(self.calibration.matrix_array, design).ravel()
        for row, share in zip(self._matrix().iter_rows(named=True), shares, strict=True):
            low, high = row.get("low"), row.get("high")
            interval = NOTHING if low is None else "by design" if low == high else f"{low:+.7f} to {high:+.7f}"
            values = (f"{row[name]:+.7f}" for name in ("design", "value"))
            change = "design 0" if math.isnan(share) else f"{100 * share:+.2f} %"
            name = f"{'w' if row['row'] == 'heading' else row['row']}: {row['signal']}"
            rows.append((name, *values, row["unit"], change, interval))
        return _values_table(heading or self.heading, rows, self._kept)

    @property
    def _kept(self) -> str:
        """Motions of which the data say nothing."""
        kept = () if self.run is None else self.run.kept
        motions = " and ".join(f"{each.words} ({each.motion})" for each in kept)
        return f"the design values are kept along {motions}, of which these data say nothing" if kept else ""

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        numbers = dict.fromkeys(("design", "value", "low", "high"), pl.Float64)
        schema = dict.fromkeys(("name", "design", "value", "unit"), pl.String) | numbers
        rows = [each.model_dump() for each in self.parameters.values()]
        return {"matrix": self._matrix, "parameters": lambda: pl.DataFrame(rows, schema)}

    def _matrix(self) -> pl.DataFrame:
        """Elements with their standard deviations by the covariance; of a run also with their 95 % intervals.

        A file does not say by how many runs its covariance is known, and so has no intervals.
        """
        calibration, signals = self.calibration, self.calibration.robot.drive.names
        columns = {"value": calibration.matrix_array, "design": calibration.robot.inverse_kinematic_matrix}
        columns["standard_deviation"] = np.full(columns["value"].shape, np.nan)
        if calibration.covariance is not None:
            variances = np.diag(np.array(calibration.covariance))[: columns["value"].size]
            columns["standard_deviation"] = np.sqrt(np.where(variances > 0, variances, np.nan))
        if self.run is not None and self.run.uncertainty is not None:
            columns |= {end: getattr(self.run.uncertainty.intervals, end) for end in ("low", "high")}
        named = {
            "row": [row for row in _ROWS for _ in signals],
            "signal": [*signals] * len(_ROWS),
            "unit": [unit for unit in _ROWS.values() for _ in signals],
        }
        return pl.DataFrame(named | {name: each.ravel() for name, each in columns.items()}).fill_nan(None)

    def figure(self, dataset: Dataset | None = None) -> go.Figure:
        """The elements' differences from the design or, with a data set, paths of a few runs before and after."""
        if dataset is None:
            return drawn(self.deviations())
        require_type(dataset, Dataset, "load_dataset")
        self.calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
        held_out = dataset.split("validation")
        runs = [run for run in held_out or dataset.trajectories if len(run.poses) > 1]
        grid = paths_before_after(runs, _models(self.calibration, dataset), "held-out" if held_out else "")
        if grid is None:
            raise DataError(f"data set {dataset.name}: no run has a path of poses to draw")
        return drawn(grid)

    def deviations(self) -> page.FigureGrid:
        """Each element's difference from the design, in % of its row's scale, with its interval or its deviation."""
        frame = self._matrix()
        scales = np.repeat(self.calibration.robot.row_scales, len(self.calibration.robot.drive.names)) / 100
        value, deviation = frame["value"], frame["standard_deviation"]
        bars, (low, high) = "standard deviations", (value - deviation, value + deviation)
        if "low" in frame.columns:
            bars, (low, high) = "95 % intervals", (frame["low"], frame["high"])
        names = [text(f"{row}: {signal}") for row, signal in zip(frame["row"], frame["signal"], strict=True)]
        ends = {"array": ((high - value) / scales).to_list(), "arrayminus": ((value - low) / scales).to_list()}
        at, marker = ((value - frame["design"]) / scales).to_list(), {"color": CALIBRATED, "size": 9}
        dots = go.Scatter(x=at, y=names, mode="markers", marker=marker, error_x={"type": "data", **ends})
        figure = plot(dots, x_title="difference from the design, % of the row's scale")
        figure.add_vline(x=0.0, line={"width": 1, "dash": "dot"})
        figure.update_yaxes(autorange="reversed", automargin=True)
        title = f"{self.calibration.name}: elements of the matrix with {bars}"
        height = 100 + 24 * len(names)
        return page.FigureGrid(
            (page.Figure(title, figure, f"{title}: {', '.join(names)}", height),), (), 1, "", "matrix"
        )


@dataclass(eq=False, repr=False)
class EvaluationResult(Result):
    """An evaluation: errors on every split beside those of the design, and errors to expect on paths.

    evaluation: None where only paths were asked for. The other arguments are those of a calibration's result.
    """

    evaluation: Evaluation | None
    calibration: Calibration | None = None
    paths: Sequence[PathError] = ()
    dataset: Dataset | None = None
    file: Path | None = None
    sources: Sequence[Path] = ()
    warnings: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.evaluation is not None:
            self.title = f"Evaluation on {self.evaluation.dataset!r}, {plural(self.evaluation.trajectories, 'run')}"

    def sentence(self) -> str:
        return "" if self.evaluation is None else self.evaluation.held_out.sentence

    def next_step(self) -> NextStep:
        if self.evaluation is None:
            other = ("omnibench", "evaluate", self.file, "DATASET")
            return NextStep("these errors are predicted", "see those on recordings", other)
        assert self.calibration is not None
        assert self.file is not None
        return next_step(self.calibration, self.evaluation.held_out, self.file, self.sources)

    def tables(self) -> Sequence[page.Table]:
        tables = [] if self.evaluation is None else [error_table(self.evaluation)]
        if self.evaluation is not None and any(errors.references for errors in self.evaluation.splits.values()):
            tables.append(reference_table(self.evaluation))
        if self.paths and self.calibration is not None:
            tables.append(path_table(self.paths, self.calibration))
        return tables

    def remarks(self) -> Sequence[Remark]:
        if self.evaluation is None or self.calibration is None:
            return ()
        return [*verdict_remarks(self.evaluation.held_out), *map(Remark, self.evaluation.sessions)]

    def json(self) -> Mapping[str, Any]:
        document = {} if self.evaluation is None else self.evaluation.model_dump()
        return document | {"paths": [each.model_dump() for each in self.paths], "warnings": list(self.warnings)}

    def document(self) -> page.Document:
        assert self.evaluation is not None
        assert self.calibration is not None
        assert self.dataset is not None
        told = self.evaluation
        return calibration_document(self.calibration, self.dataset, told.held_out, told.warnings, told.sessions)

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        assert self.evaluation is not None
        references = [labels | dict(at) for labels, errors in self._of_models() for at in errors.references]
        return {"splits": self._splits, **({"references": lambda: pl.DataFrame(references)} if references else {})}

    def _splits(self) -> pl.DataFrame:
        rows = [labels | {name: vars(errors)[name] for name in _FINAL} for labels, errors in self._of_models()]
        return pl.DataFrame(rows, infer_schema_length=None)

    def _of_models(self) -> Iterator[tuple[dict[str, Any], SplitErrors]]:
        """The errors on every split with its name and the model's."""
        assert self.evaluation is not None
        for model, splits in (("calibration", self.evaluation.splits), ("design", self.evaluation.design)):
            for split, errors in splits.items():
                yield {"split": split, "model": model}, errors

    def figure(self) -> go.Figure:
        """Mean position errors on every split, before and after."""
        frame = self._splits()
        bars = []
        for model, item in zip(_MODELS, (DESIGN_ITEM, _CALIBRATED), strict=True):
            rows = frame.filter(pl.col("model") == model)
            values = (1000 * rows["position_mean_m"].cast(pl.Float64)).to_list()
            bars.append(go.Bar(x=rows["split"].to_list(), y=values, name=model, marker_color=item.colour))
        figure = go.Figure(bars, layout=plot(y_title="mean position error at the end (mm)").layout)
        return figure.update_layout(title_text=text(f"{self.title}: before and after"), showlegend=True)


def next_step(
    calibration: Calibration, verdict: HeldOutVerdict | None, file: Path, sources: Sequence[Path]
) -> NextStep:
    """The end of ``calibrate`` and ``evaluate``: use a calibration, record more, or look for faults."""
    found, inspect = "unknown" if verdict is None else verdict.verdict, ("omnibench", "inspect", *sources)
    if found == "better" and verdict is not None:
        basis = "on runs that were held out" if verdict.basis == "held_out" else "by cross-validation"
        return NextStep(f"{file} is better than the design {basis}", *how_to_use(calibration, file))
    if found == "worse":
        return NextStep(f"{file} is worse than the design: do not use it", "see what the recordings lack", inspect)
    if found == "undecided":
        more = "record more runs for validation; what these tell"
        return NextStep(f"whether {file} is better than the design is open: do not rely on it yet", more, inspect)
    other = ("omnibench", "evaluate", file, "DATASET")
    return NextStep(f"{file} was not judged by other runs", "try it on a recording that it was not fitted to", other)


def how_to_use(calibration: Calibration, file: Path) -> tuple[str, tuple[object, ...]]:
    """The next step with a calibration, then the words to type: an export, or a node if none holds it."""
    if calibration.plain is None and left_out(calibration):
        return "name it in the config of a live node, which alone has its effects", ("omnibench", "guide", "live")
    # The format to try first: parameters of a ROS 2 controller where one suits the robot.
    export_format = "ros2_controllers"
    try:
        export_calibration(calibration, export_format)
    except ConfigError:
        export_format = "c_header"
    return "use it on the robot", ("omnibench", "export", file, "--to", export_format)


def verdict_remarks(verdict: HeldOutVerdict | None) -> list[Remark]:
    """What held-out runs say, and which these are."""
    if verdict is None:
        return []
    detail, _, _ = verdict.detail.partition("; runs: ")  # which runs these are, the report says
    return [Remark(verdict.sentence, _TONES[verdict.verdict]), *([Remark(detail)] if detail else [])]


def _models(calibration: Calibration, dataset: Dataset) -> Models:
    """The design and the calibration."""
    design = OdometryModel.of_design(dataset.robot, calibration.integration)
    return ((DESIGN_ITEM, design), (_CALIBRATED, calibration.model))


def calibration_document(
    found: Calibration | CalibrationRun,
    dataset: Dataset,
    verdict: HeldOutVerdict,
    warnings: Sequence[str] = (),
    sessions: Sequence[str] = (),
) -> page.Document:
    """The report of a calibration on the runs of a data set: on those that the verdict is of, or else on all.

    sessions: sentences on those that differ or could not be compared. DataError: a recording lacks what an effect of
    the calibration needs.
    """
    judged = [run for run in dataset.trajectories if run.id in set(verdict.runs)]
    runs, which = (judged, "held-out") if judged else (list(dataset.trajectories), "recorded")
    shown = CalibrationResult(found)
    calibration, models = shown.calibration, _models(shown.calibration, dataset)
    errors = [ModelErrors.of(model, runs) for _, model in models]
    groups = {"all": runs} | {kind: [runs[index] for index in like] for kind, like in kinds_of(runs).items()}
    rows = []
    for name, group in groups.items():
        both = [of_model.on(group) for of_model in errors]
        places = (significant(None if each.position_mean_m is None else 1e3 * each.position_mean_m) for each in both)
        turns = (None if each.heading_mean_rad is None else math.degrees(each.heading_mean_rad) for each in both)
        rows.append(page.Row.of(name, str(len(group)), *places, *(fixed(turn, 2) for turn in turns)))
    _, _, *means = (cell.text for cell in rows[0].cells)
    tiles = [
        page.Fact(what, f"{before} → {after}{unit}", "mean error of the final pose")
        for what, before, after, unit in (("Position", *means[:2], " mm"), ("Heading", *means[2:], "°"))
        if NOTHING not in (before, after)
    ]
    if verdict.improvement is not None:
        known = verdict.low is not None and verdict.high is not None
        ends = (percent(None if each is None else -each, signed=True) for each in (verdict.high, verdict.low))
        interval = f"95 %: {' to '.join(ends)}" if known else "no interval: too few"
        tiles.append(page.Fact("Change of the final error", percent(-verdict.improvement, signed=True), interval))
    headings = (f"{what}, {model} ({unit})" for what, unit in _UNITS.items() for model in _MODELS)
    of_motions = page.Table(
        f"Mean errors of the final pose of the {which} runs", page.columns("motion", "runs", *headings), tuple(rows)
    )
    sections = [page.Section("motions", "Errors by motion", (of_motions,))]
    if shown.parameters:
        sections.insert(0, page.Section("parameters", "Radii, lengths and angles", (parameter_table(calibration),)))
    if predicted := predicted_errors(calibration):
        expected = (path_table(predicted, calibration),)
        sections.append(page.Section("paths", "What to expect on other paths", expected))
    origin = calibration.provenance
    made = [("Verdict", typeset(verdict.sentence), typeset(verdict.detail))]
    made += [("Effects", calibration.effects_in_words, "")] if calibration.effects else []
    if calibration.noise is not None:
        made.append(("Noise of the reference", "; ".join(noise_in_words(calibration.noise)), ""))
    if origin is not None:
        options, versions = (
            ", ".join(f"{name} {value}" for name, value in each.items()) for each in (origin.options, origin.versions)
        )
        made += [
            ("Fitted to", origin.dataset, f"hash {origin.dataset_hash}"),
            ("Calibrator", origin.calibrator, options),
            ("Outcome", origin.outcome, typeset(origin.reason)),
            ("Versions", versions, ""),
        ]
    return page.Document(
        title=f"Calibration of {dataset.robot.name}",
        subtitle=f"{calibration.name}, on {plural(len(runs), f'{which} run')} of {dataset.name}",
        sections=(
            page.answer_section(
                typeset(f"{verdict.sentence[:1].upper()}{verdict.sentence[1:]}."),
                tiles,
                page.Callout("Sessions", tuple(map(typeset, sessions)), "warning") if sessions else None,
                paths_before_after(runs, models, which),
                page.Callout("What these data leave open", tuple(map(typeset, warnings)), "warning"),
            ),
            *sections,
            page.Section("matrix", "The matrix", (shown.deviations(), shown.elements("element"))),
            page.Section("origin", "How it was made", (page.Facts(tuple(page.Fact(*each) for each in made)),)),
        ),
        badges=page.simulated_badge(dataset.simulated),
    )


def parameter_table(calibration: Calibration, title: str = "parameter") -> page.Table:
    """The physical parameters beside the design: angles in degrees, and differences from the design in % or degrees."""
    rows = [(each.name, *parameter_cells(each)) for each in calibration.physical_parameters.values()]
    return _values_table(title, rows)


def parameter_cells(parameter: PhysicalParameter) -> tuple[str, str, str, str, str]:
    """Design, value, their unit, the change and the interval of a parameter."""
    factor, decimals, unit = {"rad": (math.degrees(1.0), 3, "deg"), "1": (1.0, 4, "")}.get(
        parameter.unit, (1.0, 5, parameter.unit)
    )
    # An angle's zero is a convention, so that no share of it means anything
    share = None if parameter.unit == "rad" else parameter.deviation_percent
    change = f"{factor * parameter.deviation:+.{decimals}f} {unit}" if share is None else f"{share:+.2f} %"
    ends = [] if parameter.low is None or parameter.high is None else [parameter.low, parameter.high]
    interval = " to ".join(f"{factor * end:.{decimals}f}" for end in ends) or NOTHING
    design, value = (f"{factor * each:.{decimals}f}" for each in (parameter.design, parameter.value))
    return design, value, unit, change, interval


def _values_table(heading: str, rows: Sequence[Sequence[str]], note: str = "") -> page.Table:
    """Values beside the design: name, design, value, unit, change, interval."""
    unit = page.Column("", numeric=False)
    columns = page.columns(heading, "design", "value", unit, "change", "95 %")
    return page.Table("", columns, tuple(page.Row.of(*row) for row in rows), note)


def error_table(evaluation: Evaluation) -> page.Table:
    """Cost and errors of the final pose on every split, by the calibration and by the design."""
    rows = []
    for split, errors in evaluation.splits.items():
        if split == "all" and len(evaluation.splits) > 2:  # the rows above say it
            continue
        where = f"{split}: {plural(errors.trajectories, 'run')}"
        if evaluation.unfitted is not None:
            part, whole = evaluation.unfitted[split], errors.trajectories
            where += f", {({0: 'none', whole: 'all'}).get(part, f'{part:,}')} held out"
        if errors.outside is not None:
            where += f", {100 * errors.outside:.0f} % of the time outside of what it was fitted to"
        rows.append(page.Row.of(where, role="group"))
        for label, each in (("calibration", errors), ("design", evaluation.design[split])):
            metres = (fixed(value, 4) for value in (each.position_mean_m, each.position_max_m))
            angles = (each.heading_mean_rad, each.heading_max_rad)
            degrees = (fixed(None if value is None else math.degrees(value), 2) for value in angles)
            rows.append(page.Row.of(label, f"{each.cost:.4f}", *metres, *degrees))
    errors_of = (
        f"{what}, {which} ({unit})"
        for what, unit in (("position", "m"), ("heading", "deg"))
        for which in ("mean", "max")
    )
    columns = page.columns("model", "Eq. (6)", *errors_of)
    kind = " (simulated data)" if evaluation.simulated else ""
    note = f"fitted with the loss {evaluation.loss}; the errors are without it" if evaluation.loss else ""
    return page.Table(f"{evaluation.dataset}{kind}", columns, tuple(rows), note)


def reference_table(evaluation: Evaluation) -> page.Table:
    """Errors at references other than poses, by kind."""
    rows = []
    for split, errors in evaluation.splits.items():
        for fitted, before in zip(errors.references, evaluation.design[split].references, strict=True):
            angle = fitted.unit == "rad"
            sizes = (
                f"{math.degrees(value):.2f} deg" if angle else f"{1000 * value:.1f} mm"
                for value in (fitted.mean, fitted.max, before.mean, before.max)
            )
            ratios = (f"{fitted.in_sigmas:.1f}", f"{before.in_sigmas:.1f}")
            rows.append(page.Row.of(split, fitted.kind, str(fitted.references), *sizes, *ratios))
    kind, largest = page.Column("reference", numeric=False), page.Column("largest", priority=1)
    by_design = page.Column("design: in sigmas", priority=1)
    columns = page.columns("runs", kind, "number", "mean", largest, "design: mean", largest, "in sigmas", by_design)
    note = "in sigmas: root mean square of errors in the references' own standard deviations, 1 if the model is right"
    return page.Table("errors by kind of reference", columns, tuple(rows), note)


def path_table(errors: Sequence[PathError], calibration: Calibration) -> page.Table:
    """The errors to expect at the ends of paths, by the design and by the calibration, with what holds 95 % of them."""
    rows = []
    for path in dict.fromkeys(error.path for error in errors):
        by_model = {error.model: error for error in errors if error.path == path}
        both = [by_model[model] for model in _MODELS]
        places = (f"{_figures(1e3 * each.position_m)} ({_figures(1e3 * each.position_95_m)})" for each in both)
        turns = (f"{math.degrees(each.heading_rad):.2f} ({math.degrees(each.heading_95_rad):.2f})" for each in both)
        rows.append(page.Row.of(path, *places, *turns))
    columns = page.columns("path", *(f"{what}, {model} ({unit})" for what, unit in _UNITS.items() for model in _MODELS))
    runs = "" if calibration.slip is None else f"; slip as of {plural(calibration.slip.runs, 'training run')}"
    return page.Table(f"errors to expect at a path's end (95 % lie within){runs}", columns, tuple(rows))


def _figures(value: float) -> str:
    """A number with two figures, or all before its point."""
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"
