"""The report of a design: one HTML file that opens offline."""

from __future__ import annotations

from pathlib import Path

from omnibench.design.report.design_figures import efficiency_figure, path_figures, precision_figures
from omnibench.design.report.design_wording import (
    UNIT_OF_COST,
    USE_IN_WORDS,
    baseline_runs,
    choice_in_words,
    command_in_words,
    duration_in_words,
    effort_in_words,
    equal_in_words,
    headline,
    least_in_words,
    origin_in_words,
)
from omnibench.design.result import Candidate, Design, SetDesign
from omnibench.report.blocks import (
    Badge,
    Block,
    Callout,
    Cell,
    Column,
    Details,
    Document,
    Fact,
    Facts,
    Paragraph,
    Row,
    Section,
    Table,
    simulated_badge,
)
from omnibench.report.numbers import NOTHING, count, fixed, listing, percent, significant
from omnibench.report.render import write_document
from omnibench.words import plural


def write_design_report(design: Design, path: Path) -> None:
    """Write the report of a design to ``path``, whole or not at all. DataError when the disk refuses."""
    write_document(design_document(design), path)


def design_document(design: Design) -> Document:
    """The report as blocks."""
    return Document(
        title=f"Which commands are worth driving: {design.name}",
        subtitle=design.description,
        sections=(
            Section("result", "Result", _result(design)),
            Section("commands", "Chosen commands", _commands(design)),
            Section("precision", "Precision against runs", _precision(design)),
            Section("efficiency", "Efficiency against the bound", (efficiency_figure(design),)),
            Section("basis", "What this rests on", _basis(design)),
        ),
        badges=_badges(design),
    )


def _badges(design: Design) -> tuple[Badge, ...]:
    if not design.recorded:
        return (Badge("ASSUMED NOISE, NO RECORDINGS", "warning"),)
    return simulated_badge(design.simulated)


def _result(design: Design) -> tuple[Block, ...]:
    tiles = []
    for of_set in design.sets:
        equal = next(equal for equal in of_set.equivalents if equal.use == design.use)
        effort = equal.effort
        tiles += [
            Fact(
                f"{of_set.name}: chosen",
                plural(of_set.step.effort.runs, "run"),
                f"{percent(of_set.step.efficiency, 2)} of the bound; {duration_in_words(of_set.step.effort.seconds)}",
            ),
            Fact(
                f"{of_set.name}: equal to the baseline's {baseline_runs(design)}",
                "none allowed" if effort is None else plural(effort.runs, "run"),
                "" if effort is None else f"{duration_in_words(effort.seconds)} of driving",
            ),
        ]
    return (
        Paragraph(headline(design), "lead"),
        Facts(tuple(tiles), "tiles"),
        _equal_table(design),
        Callout("Before you read on", design.notes),
    )


def _equal_table(design: Design) -> Table:
    rows = []
    for of_set in design.sets:
        for equal in of_set.equivalents:
            effort = equal.effort
            reason = (
                "they leave part of the matrix undetermined"
                if equal.least is None
                else "not within the repetitions allowed"
            )
            cells = [Cell(NOTHING, reason), Cell(NOTHING), Cell(NOTHING)]
            if effort is not None:
                cells = [
                    Cell(count(effort.runs)),
                    Cell(duration_in_words(effort.seconds)),
                    Cell(f"{significant(effort.metres, 3)} m"),
                ]
            least = NOTHING if equal.least is None else least_in_words(equal.least)
            rows.append(Row((Cell(of_set.name), Cell(USE_IN_WORDS[equal.use]), *cells, Cell(least))))
    effort = design.baseline.precision.effort
    return Table(
        f"As good as the baseline: {design.baseline.name} ({effort_in_words(effort)})",
        (
            Column("Candidates", numeric=False),
            Column("Calibrated from", numeric=False),
            Column("Runs"),
            Column("Time"),
            Column("Distance"),
            Column("Bound", UNIT_OF_COST[design.per]),
        ),
        tuple(rows),
        "The smallest design found whose det(information)^(1/p) is at least the baseline's; no design at all can do "
        "it with less than the bound in the last column. Final poses are taken as Eq. (6) does, with equal noise in m "
        "and rad; whole trajectories by every reference pose under the noise model.",
    )


def _commands(design: Design) -> tuple[Block, ...]:
    blocks: list[Block] = [path_figures(design)]
    for of_set in design.sets:
        blocks += [
            Paragraph(f"{of_set.name}: {choice_in_words(design, of_set)}"),
            _chosen_table(design, of_set),
        ]
        equal = f"{of_set.name} equals the baseline with {equal_in_words(design, of_set, design.use)}"
        blocks.append(Paragraph(f"{equal}, calibrated from {USE_IN_WORDS[design.use]}.", "note"))
    return tuple(blocks)


def _chosen_table(design: Design, of_set: SetDesign) -> Table:
    rows = tuple(
        Row(
            (
                *_command_cells(design.candidate(chosen.command)),
                Cell(count(chosen.runs)),
                Cell(percent(of_set.optimum.shares.get(chosen.command, 0.0))),
            )
        )
        for chosen in of_set.chosen
    )
    unit = {"run": "runs", "second": "time", "metre": "wheels' distance"}[design.per]
    return Table(
        f"What to drive of {of_set.name}: {effort_in_words(of_set.step.effort)}",
        (*_COMMAND_COLUMNS, Column("Runs"), Column("Continuous optimum", f"share of the {unit}")),
        rows,
        "Other choices may be as good: turning all directions of a design by the same angle often changes nothing.",
    )


_COMMAND_COLUMNS = (
    Column("Command", numeric=False),
    Column("Duration", "s"),
    Column("Distance", "m"),
    Column("Wheels roll", "m"),
)


def _command_cells(candidate: Candidate) -> tuple[Cell, ...]:
    return (
        Cell(command_in_words(candidate), candidate.name),
        Cell(fixed(candidate.duration_s, 2)),
        Cell(fixed(candidate.distance_m, 2)),
        Cell(fixed(candidate.rolled_m, 2)),
    )


def _precision(design: Design) -> tuple[Block, ...]:
    physical = design.baseline.precision.physical is not None
    columns = [
        Column("Runs"),
        Column("Time"),
        Column("Against the baseline"),
        *(Column(f"Row {number}", "% of largest") for number in (1, 2, 3)),
    ]
    if physical:
        columns += [Column("Radius", "%"), Column("Distance", "%"), Column("Angle", "deg")]
    rows = []
    for title, precision in (
        *((of_set.name, of_set.step) for of_set in design.sets),
        (f"baseline: {design.baseline.name}", design.baseline.precision),
    ):
        cells = [
            Cell(title),
            Cell(count(precision.effort.runs)),
            Cell(duration_in_words(precision.effort.seconds)),
            Cell(f"× {significant(precision.relative, 3)}"),
            *(Cell(significant(value, 3)) for value in precision.row_percent),
        ]
        if precision.physical is not None:
            spread = precision.physical
            values = (spread.radius_percent, spread.distance_percent, spread.angle_deg)
            cells += [Cell(significant(value, 3)) for value in values]
        rows.append(Row(tuple(cells)))
    table = Table(
        "Standard deviations that the chosen runs promise",
        (Column("Design", numeric=False), *columns),
        tuple(rows),
        "Of each row, and of each kind of physical parameter, the largest. They fall with the root of the number of "
        "runs when a design is repeated.",
    )
    return (precision_figures(design), table)


def _basis(design: Design) -> tuple[Block, ...]:
    noise = design.noise
    per_root = "per √s"
    facts = (
        Fact("Source", design.source),
        Fact("Candidates and noise", origin_in_words(design)),
        Fact(
            "Noise of positions",
            f"white {_small(noise.pose_position)} m, walk {_small(noise.walk_position)} m {per_root}, "
            f"bias {_small(noise.bias_position)} m",
        ),
        Fact(
            "Noise of headings",
            f"white {_small(noise.pose_heading)} rad, walk {_small(noise.walk_heading)} rad {per_root}, "
            f"bias {_small(noise.bias_heading)} rad",
        ),
        Fact("Robot", design.robot),
        Fact("Elements determined", f"{design.parameters} of the inverse kinematic matrix"),
        Fact("Odometry", "exact arcs" if design.integration == "arc" else "Euler steps, Eq. (1)"),
        Fact("Calibrated from", USE_IN_WORDS[design.use]),
        Fact("Measure", f"information per {design.per}"),
        Fact(
            "Continuous optima",
            listing([f"{of_set.name}: within {100 * of_set.optimum.gap:.1g} % of its bound" for of_set in design.sets]),
        ),
    )
    rows = tuple(Row(_command_cells(candidate)) for candidate in design.candidates)
    table = Table(f"All {len(rows)} candidates", _COMMAND_COLUMNS, rows)
    return (Facts(facts), Details(f"All candidates ({len(rows)})", (table,)))


def _small(value: float) -> str:
    return significant(value, 2)
