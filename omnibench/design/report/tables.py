"""The report of a design and its tables: what to drive, how precise it is, the baseline's equals."""

from __future__ import annotations

from omnibench.design.report.design_figures import (
    UNIT_OF_COST,
    USE_IN_WORDS,
    baseline_runs,
    choice_in_words,
    command_in_words,
    duration_in_words,
    efficiency_figure,
    effort_in_words,
    equal_in_words,
    headline,
    least_in_words,
    motions_in_words,
    origin_in_words,
    path_figures,
    plan_in_words,
    precision_figures,
)
from omnibench.design.result import Candidate, Design, Precision, SetDesign, Step
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
    RowRole,
    Section,
    Table,
    answer_section,
    simulated_badge,
)
from omnibench.report.numbers import NOTHING, count, fixed, listing, noise_in_words, percent, significant
from omnibench.words import plural

# Designs in the table against the number of runs, beside the chosen one and the baseline. Only the table's length hangs
# on it: 6 and 15 lines in the place of 9 with half of it and with twice (tests/studies/constants_fit.py).
_ROWS = 7
_COMMAND_COLUMNS = (
    Column("Command", numeric=False),
    Column("Duration", "s"),
    Column("Distance", "m"),
    Column("Wheels roll", "m", priority=2),
)


def equal_table(design: Design) -> Table:
    """The smallest designs that give as much information as the baseline, set by set."""
    rows = []
    for of_set in design.sets:
        for equal in of_set.equivalents:
            effort = equal.effort
            reason = (
                "they leave part of the matrix undetermined"
                if equal.least is None
                else "not within the repetitions allowed"
            )
            cells: tuple[Cell | str, ...] = (Cell(NOTHING, reason), NOTHING, NOTHING)
            if effort is not None:
                distance = f"{significant(effort.metres, 3)} m"
                cells = (count(effort.runs), duration_in_words(effort.seconds), distance)
            least = NOTHING if equal.least is None else least_in_words(equal.least)
            rows.append(Row.of(of_set.name, USE_IN_WORDS[equal.use], *cells, least))
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


def chosen_table(design: Design, of_set: SetDesign) -> Table:
    """The chosen commands of a set."""
    rows = (
        Row.of(
            *_command_cells(design.candidate(chosen.command)),
            count(chosen.runs),
            percent(of_set.optimum.shares.get(chosen.command, 0.0)),
        )
        for chosen in of_set.chosen
    )
    unit = {"run": "runs", "second": "time", "metre": "wheels' distance"}[design.per]
    return Table(
        f"What to drive of {of_set.name}: {effort_in_words(of_set.step.effort)}",
        (*_COMMAND_COLUMNS, Column("Runs"), Column("Continuous optimum", f"share of the {unit}", priority=1)),
        tuple(rows),
        "Other choices may be as good: turning all directions of a design by the same angle often changes nothing.",
    )


def _command_cells(candidate: Candidate) -> tuple[Cell, ...]:
    words = command_in_words(candidate)
    return (
        Cell(words, "" if candidate.name == words else candidate.name),
        Cell(fixed(candidate.duration_s, 2)),
        Cell(fixed(candidate.distance_m, 2)),
        Cell(fixed(candidate.rolled_m, 2)),
    )


def promise_table(design: Design) -> Table:
    """The precision that the chosen runs of every set promise, beside the baseline's."""
    rows = [_precision_row(of_set.name, of_set.step) for of_set in design.sets]
    baseline = _precision_row(f"baseline: {design.baseline.name}", design.baseline.precision)
    return Table(
        "Standard deviations that the chosen runs promise",
        _precision_columns(design, Column("Design", numeric=False)),
        (*rows, baseline),
        "Of each row, and of each kind of physical parameter, the largest. They fall with the root of the number of "
        "runs when a design is repeated.",
    )


def effort_table(design: Design, of_set: SetDesign) -> Table:
    """The precision against the number of runs: some of a set's best designs, the chosen one, and the baseline."""
    chosen = of_set.step.effort.runs
    rows = [
        _precision_row(percent(step.efficiency, 2), step, "best" if step.effort.runs == chosen else "plain")
        for step in _worth_a_row(of_set)
    ]
    baseline = _precision_row(percent(of_set.baseline_efficiency, 2), design.baseline.precision, "muted")
    return Table(
        f"Standard deviations against the number of runs of {of_set.name}",
        _precision_columns(design, Column("Of the bound")),
        (*rows, baseline),
        f"Last line: the baseline, {design.baseline.name}.",
    )


def _worth_a_row(of_set: SetDesign) -> list[Step]:
    """The chosen step and some others, spaced evenly on a logarithmic scale."""
    first, last = of_set.steps[0].effort.runs, of_set.steps[-1].effort.runs
    wanted = [first * (last / first) ** (index / (_ROWS - 1)) for index in range(_ROWS)]
    shown = {min(of_set.steps, key=lambda step: abs(step.effort.runs - runs)).effort.runs for runs in wanted}
    return [step for step in of_set.steps if step.effort.runs in shown | {of_set.step.effort.runs}]


def _precision_columns(design: Design, first: Column) -> tuple[Column, ...]:
    physical = [Column(*kind, priority=1) for kind in (("Radius", "%"), ("Distance", "%"), ("Angle", "°"))]
    return (
        first,
        Column("Runs"),
        Column("Time"),
        Column("Against the baseline"),
        *(Column(f"Row {number}", "% of largest") for number in (1, 2, 3)),
        *(physical if design.baseline.precision.physical is not None else ()),
    )


def _precision_row(name: str, precision: Precision, role: RowRole = "plain") -> Row:
    values = list(precision.row_percent)
    if precision.physical is not None:
        spread = precision.physical
        values += [spread.radius_percent, spread.distance_percent, spread.angle_deg]
    return Row.of(
        name,
        count(precision.effort.runs),
        duration_in_words(precision.effort.seconds),
        f"× {significant(precision.relative, 3)}",
        *(significant(value, 3) for value in values),
        role=role,
    )


def design_document(design: Design) -> Document:
    """The report as blocks."""
    return Document(
        title=f"Which commands are worth driving: {design.name}",
        subtitle=design.description,
        sections=(
            _answer(design),
            Section("commands", "Chosen commands", _commands(design)),
            Section(
                "precision",
                "Precision against runs",
                (precision_figures(design), promise_table(design), equal_table(design)),
                about="How well the matrix is known after so many runs, beside the baseline.",
                folded=True,
            ),
            Section(
                "efficiency",
                "Efficiency against the bound",
                (efficiency_figure(design),),
                about="How near the chosen runs are to the best that any choice could reach.",
                folded=True,
            ),
            Section(
                "basis",
                "What this rests on",
                _basis(design),
                about="Candidates, noise and source.",
                folded=True,
            ),
        ),
        badges=_badges(design),
    )


def _badges(design: Design) -> tuple[Badge, ...]:
    if not design.recorded:
        return (Badge("ASSUMED NOISE, NO RECORDINGS", "warning"),)
    return simulated_badge(design.simulated)


def _answer(design: Design) -> Section:
    """The section with the answer: what to drive, in words and as a picture of the paths."""
    tiles = []
    for of_set in design.sets:
        equal = next(equal for equal in of_set.equivalents if equal.use == design.use)
        effort, name = equal.effort, f"{of_set.name}: " * (len(design.sets) > 1)
        tiles += [
            Fact(
                f"{name}chosen" if name else "Chosen",
                plural(of_set.step.effort.runs, "run"),
                f"{percent(of_set.step.efficiency, 2)} of the bound; {duration_in_words(of_set.step.effort.seconds)}",
            ),
            Fact(
                f"{name}{'equal' if name else 'Equal'} to the baseline's {baseline_runs(design)}",
                "none allowed" if effort is None else plural(effort.runs, "run"),
                "" if effort is None else f"{duration_in_words(effort.seconds)} of driving",
            ),
        ]
    plans = []
    if not design.recorded:
        title = "What to drive" + " of {}" * (len(design.sets) > 1)
        plans = [Callout(title.format(of_set.name), plan_in_words(design, of_set)) for of_set in design.sets]
    notes = Callout("Before you rely on it", design.notes)
    return answer_section(headline(design), tiles, path_figures(design), *plans, notes)


def _commands(design: Design) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for of_set in design.sets:
        blocks += [
            Paragraph(f"{of_set.name}: {choice_in_words(design, of_set)}"),
            chosen_table(design, of_set),
            Paragraph(motions_in_words(of_set)),
        ]
        equal = f"{of_set.name} equals the baseline with {equal_in_words(design, of_set, design.use)}"
        blocks.append(Paragraph(f"{equal}, calibrated from {USE_IN_WORDS[design.use]}.", "note"))
    return tuple(blocks)


def _basis(design: Design) -> tuple[Block, ...]:
    position, heading = noise_in_words(design.noise)
    facts = (
        Fact("Source", design.source),
        Fact("Candidates and noise", origin_in_words(design)),
        Fact("Noise of positions", position),
        Fact("Noise of headings", heading),
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
    rows = tuple(Row.of(*_command_cells(candidate)) for candidate in design.candidates)
    return (
        Facts(facts),
        Details(
            f"All candidates ({len(design.candidates)})",
            (Table(f"All {len(rows)} candidates", _COMMAND_COLUMNS, rows),),
        ),
    )
