"""The report of a design: one HTML file that opens offline."""

from __future__ import annotations

from omnibench.design.report.design_figures import (
    USE_IN_WORDS,
    baseline_runs,
    choice_in_words,
    duration_in_words,
    efficiency_figure,
    equal_in_words,
    headline,
    motions_in_words,
    origin_in_words,
    path_figures,
    plan_in_words,
    precision_figures,
)
from omnibench.design.report.tables import candidate_table, chosen_table, equal_table, promise_table
from omnibench.design.result import Design
from omnibench.report.blocks import (
    Badge,
    Block,
    Callout,
    Details,
    Document,
    Fact,
    Facts,
    Paragraph,
    Section,
    answer_section,
    simulated_badge,
)
from omnibench.report.numbers import listing, noise_in_words, percent
from omnibench.words import plural


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
    return (Facts(facts), Details(f"All candidates ({len(design.candidates)})", (candidate_table(design),)))
