"""The report of a discovery as one HTML file: where the model fails, what is missing, how sure, how much better."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from omnibench.discover.report import tables
from omnibench.discover.report.evidence_figures import candidate_grid, gap_grid, hidden_grid, waterfall_grid
from omnibench.discover.report.residuals import ALONE, EXTENDED, PLAIN
from omnibench.discover.report.where_section import where_section
from omnibench.discover.result import Discovery, Gap, NamedEffect, experiment_file
from omnibench.environment import package_versions
from omnibench.report import blocks as page
from omnibench.report.numbers import count, fixed, listing, noise_in_words, typeset
from omnibench.report.path_pictures import DESIGN_ITEM, paths_before_after
from omnibench.robot.model import OdometryModel
from omnibench.words import plural


def discovery_report(discovery: Discovery, options: str) -> page.Document:
    """The report as blocks. options: the effective options, in YAML."""
    dataset, better = discovery.dataset, "How much better" if discovery.extends else "How well it predicts"
    runs = "held-out runs" if discovery.held_out else "training runs"
    return page.Document(
        title=f"What the odometry model lacks: {dataset.name}",
        subtitle=dataset.description,
        sections=(
            _answer(discovery),
            page.Section("what", "What", tuple(what_blocks(discovery)), about="What is missing, with its parameters."),
            _folded("better", better, f"Errors before and after, on {runs}.", _how_much_better(discovery)),
            replace(where_section(discovery), about="What the errors of the plain matrix depend on.", folded=True),
            _folded("sure", "How sure", "Rivals of the name, and what could still hide.", sure_blocks(discovery)),
            _folded("basis", "What this rests on", "Data, noise, options and files.", _basis(discovery, options)),
        ),
        badges=page.simulated_badge(dataset.simulated),
    )


def _folded(key: str, title: str, about: str, blocks: Iterator[page.Block]) -> page.Section:
    return page.Section(key, title, tuple(blocks), about=about, folded=True)


def _answer(discovery: Discovery) -> page.Section:
    """The section with the answer: what was gained and the cause, paths before and after, and the warnings."""
    new_motions = tables.extrapolations_in_words(discovery.extrapolations)
    answer = typeset(tables.answer_in_words(discovery))
    headline = typeset(discovery.headline)
    # Paths of a few held-out runs, or of training runs where none are held out, by both models
    dataset, training = discovery.dataset, set(discovery.trajectories)
    held_out = [run for run in dataset.trajectories if run.id not in training]
    plain = discovery.plain.model
    models: list[tuple[page.LegendItem, OdometryModel]] = [(PLAIN, plain), (EXTENDED, discovery.extended.model)]
    if not discovery.extends:
        models = [(DESIGN_ITEM, OdometryModel.of_design(dataset.robot, plain.integration)), (ALONE, plain)]
    return page.answer_section(
        answer,
        tuple(_tiles(discovery)),
        paths_before_after(held_out or dataset.trajectories, models, "held-out" if held_out else "training"),
        *([page.Paragraph(headline)] if headline != answer else []),
        page.Callout("Motions that the training runs never had", new_motions, "warning"),
        page.Callout("Before you rely on it", tuple(map(typeset, discovery.notes))),
    )


def _tiles(discovery: Discovery) -> Iterator[page.Fact]:
    held = tables.decisive(discovery)
    if held is not None:
        position, heading = tables.final_errors_in_words(discovery, held)
        where = f"{tables.held_out_in_words(discovery, held)}, {plural(held.runs, 'run')}"
        yield page.Fact("Final position error, mean", position, where)
        yield page.Fact("Final heading error, mean", heading, where)
        yield _gap_fact(discovery, held.eq6, where)
    else:
        change = f", {tables.gap_in_words(discovery.gap)}" if discovery.extends else ""
        yield _gap_fact(discovery, discovery.gap, f"training runs{change}")
    yield page.Fact("Cause" if discovery.effects else "Verdict", *_cause(discovery))


def _cause(discovery: Discovery) -> tuple[str, str]:
    """The name of what is missing, and the verdict with the weight of the name."""
    sessions = ", sessions not compared" if discovery.sessions.doubts else ""
    sessions = ", sessions differ" if discovery.sessions.differences else sessions
    verdict = f"{tables.verdict_in_words(discovery)}{sessions}"
    if not discovery.effects:
        unnamed = " and of the gap an unnamed term closes what is shown" if discovery.extends else ""
        return discovery.verdict, f"{verdict}{unnamed}"
    first, *more = discovery.effects
    others = first.confusable_with
    name = first.name.replace("_", " ")
    name += f" or {len(others)} others" if len(others) > 1 else f" or {others[0].replace('_', ' ')}" if others else ""
    name += f", and {len(more)} more" if more else ""
    if discovery.verdict == "unknown":
        verdict = f"likeliest, but no name is sure{sessions}"
    return name, f"{verdict}; weight of the name {tables.weight_in_words(first.weight)}"


def _gap_fact(discovery: Discovery, gap: Gap, where: str) -> page.Fact:
    """The share of the gap that is closed or, where nothing was added, the error beside its floor."""
    if discovery.extends:
        return page.Fact("Gap closed, Eq. (6)", tables.closed_in_words(gap), where)
    decimals = tables.gap_decimals(gap)
    floor = "" if gap.floor is None else f"floor {fixed(gap.floor, decimals)}; "
    return page.Fact("Eq. (6)", fixed(gap.before, decimals), f"{floor}{where}")


def what_blocks(discovery: Discovery) -> Iterator[page.Block]:
    """The effects: those found, with their parameters, and those that a matrix absorbs."""
    yield page.Paragraph(tables.verdict_at_length(discovery))
    if discovery.effects:
        for effect in discovery.effects:
            yield page.Callout(
                f"{effect.name}: stage {effect.stage} ({tables.STAGES[effect.stage]})", tuple(_effect_remarks(effect))
            )
        yield tables.parameter_table(discovery.effects, discovery.dataset)
    for number, experiment in enumerate(discovery.experiments, 1):
        # The paragraph, table and config of the runs that tell the members of a class apart
        yield page.Paragraph(f"To separate {listing(list(experiment.separates))}: {experiment.description}")
        if experiment.commands:
            yield tables.experiment_table(experiment)
            title = f"These runs as a config ({experiment_file(number)}): simulate them before they are driven"
            yield page.Details(title, (page.Code(experiment.config),))
    if discovery.absorbed:
        yield tables.absorbed_table(discovery)
    if discovery.not_looked_for:
        yield page.Details(
            f"Effects that these recordings cannot show ({len(discovery.not_looked_for)})",
            (tables.not_looked_for_table(discovery),),
        )


def _effect_remarks(effect: NamedEffect) -> Iterator[str]:
    yield effect.physics
    if effect.confusable_with:
        others = listing(list(effect.confusable_with))
        yield f"These data cannot tell it from {others}: any of them closes the gap as well."
    if effect.in_doubt:
        yield f"In doubt: {effect.in_doubt}."
    if effect.source:
        yield f"Described in: {effect.source}."


def sure_blocks(discovery: Discovery) -> Iterator[page.Block]:
    """Certainty: weights, candidates, what is left, look-alikes, effects that may still hide."""
    if discovery.effects:
        yield page.Facts(
            tuple(
                page.Fact(
                    tables.effect_in_words(effect).replace("_", " "),
                    tables.weight_in_words(effect.weight),
                    f"weight of the name; χ² falls by {count(effect.chi_square)} "
                    f"for {plural(effect.degrees_of_freedom, 'parameter')}",
                )
                for effect in discovery.effects
            ),
            "tiles",
        )
    yield from filter(None, [candidate_grid(discovery)])
    if discovery.left:
        caption = "What the residuals still depend on, after all that was added"
        yield tables.dependence_table(discovery.left, caption)
    elif discovery.effects:
        yield page.Paragraph(
            "With the effects that were added, the residuals depend on nothing that was tried: noise is left."
        )
    if discovery.classes:
        yield page.Callout(
            "What these data cannot tell apart", tuple(" or ".join(names) for names in discovery.classes), "plain"
        )
    if discovery.hidden:
        if (grid := hidden_grid(discovery.hidden)) is not None:
            yield grid
        yield page.Details(
            f"These effects in numbers ({len(discovery.hidden)})", (tables.hidden_table(discovery.hidden),)
        )


def _how_much_better(discovery: Discovery) -> Iterator[page.Block]:
    """The gain: errors before and after against the noise floor, on held-out runs."""
    if discovery.held_out:
        yield page.Paragraph(_better_in_words(discovery))
    yield from filter(None, [gap_grid(discovery), waterfall_grid(discovery)])
    yield tables.held_out_table(discovery) if discovery.held_out else tables.gap_table(discovery)
    if len(discovery.steps) > 1:
        yield page.Details("Every step in numbers", (tables.step_table(discovery),))
    if discovery.extrapolations:
        words = (
            "The held-out runs drive motions that no training run had. There the extended model extrapolates, and its "
            "bound may be wider than the plain matrix's.",
        )
        yield page.Callout("Warning: new motions", words, "warning")
        yield tables.extrapolation_table(discovery.extrapolations)


def _better_in_words(discovery: Discovery) -> str:
    held = tables.decisive(discovery)
    assert held is not None
    where = f"On the {tables.held_out_in_words(discovery, held)}, {plural(held.runs, 'run')}, "
    before, after = (
        f"{fixed(1e3 * position, 1)} mm and {fixed(math.degrees(heading), 2)}°"
        for position, heading in zip(held.position_m, held.heading_rad, strict=True)
    )
    if not discovery.extends:
        return f"{where}the mean final error is {after} by the plain matrix, to which nothing was added."
    closed = (
        ""
        if held.eq6.closed is None
        else f": {tables.closed_in_words(held.eq6)} of the gap down to the floor is closed"
    )
    decimals = tables.gap_decimals(held.eq6)
    return (
        f"{where}the mean final error goes from {before} by the plain matrix to {after} by the extended model; Eq. (6) "
        f"goes from {fixed(held.eq6.before, decimals)} to {fixed(held.eq6.after, decimals)}{closed}."
    )


def _basis(discovery: Discovery, options: str) -> Iterator[page.Block]:
    """The basis of it all: data, noise, options and files."""
    dataset, noise = discovery.dataset, discovery.noise
    position, heading = noise_in_words(noise.noise)
    runs = [run for run in dataset.trajectories if run.split == "train"]
    commands = {run.command for run in runs if run.command is not None}
    sessions = {run.session for run in runs if run.session is not None}
    facts = [
        page.Fact("Data set", dataset.name, "simulated" if dataset.simulated else "recorded"),
        page.Fact("Source", dataset.source),
        page.Fact(
            "Training runs",
            f"{plural(len(discovery.trajectories), 'run')}, {plural(discovery.poses, 'reference pose')}",
            f"{plural(discovery.outliers, 'pose')} left out as outliers" if discovery.outliers else "",
        ),
        page.Fact("Commands", count(len(commands)) if commands else "not known"),
        page.Fact("Sessions", listing(sorted(sessions)) if sessions else "not known"),
        page.Fact("Noise of positions", position),
        page.Fact("Noise of headings", heading),
        page.Fact(
            "Noise from",
            noise.description,
            "repetitions show it, whatever the model gets wrong"
            if noise.source == "repetitions"
            else "nothing is repeated: what no model here expresses counts as noise",
        ),
        page.Fact("Robot", dataset.robot.name, plural(len(dataset.robot.wheels), "wheel")),
        page.Fact("Odometry", "exact arcs" if discovery.extended.integration == "arc" else "Euler steps, Eq. (1)"),
        page.Fact("Content (SHA-256)", dataset.hash[:16]),
        page.Fact("Time", f"{fixed(discovery.seconds, 1)} s"),
        page.Fact("Versions", ", ".join(f"{name} {version}" for name, version in package_versions().items())),
    ]
    yield page.Facts(tuple(fact for fact in facts if fact.value))
    yield page.Callout("Warnings on reading the data", dataset.warnings, "warning")
    files = "model.yaml is the extended calibration and plain.yaml the matrix alone, both"
    if not discovery.extends:
        files = "plain.yaml is the matrix alone, to which nothing was added,"
    yield page.Paragraph(
        f"Beside this report: {files} ready for omnibench evaluate, simulate and live; discovery.json holds all "
        "figures, residuals.parquet every residual before and after."
    )
    yield page.Details("Effective options (config.yaml)", (page.Code(options),))
