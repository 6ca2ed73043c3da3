"""The page of a discovery: the answer, then where the model fails, the evidence, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from omnibench.discover.report import tables
from omnibench.discover.report.figures import ALONE, EXTENDED, PLAIN, candidate_grid, error_grid, residual_blocks
from omnibench.discover.result import Discovery, experiment_file
from omnibench.environment import package_versions
from omnibench.report import blocks as page
from omnibench.report.numbers import count, fixed, listing, noise_in_words, typeset
from omnibench.report.path_pictures import DESIGN_ITEM, Models, paths_before_after
from omnibench.robot.model import OdometryModel
from omnibench.words import plural


def discovery_report(discovery: Discovery, options: str) -> page.Document:
    """The report as blocks. options: the effective options, in YAML."""
    dataset = discovery.dataset
    alike = "Step 3, propose: effects that look alike or that no run shows, and how large one could be."
    titles: tuple[tuple[str, str, str, Iterable[page.Block]], ...] = (
        ("where", "Where it shows", "Step 2, locate: what the plain matrix's errors depend on.", _where(discovery)),
        ("alike", "What the data cannot tell", alike, alike_blocks(discovery)),
        ("evidence", "Evidence for and against", "Step 4, select: what each effect would explain.",
         evidence_blocks(discovery)),
        ("better", "Errors before and after", "Step 5, confirm: down to the floor of the noise.",
         _errors(discovery)),
        ("parameters", "Parameters", "Step 6, conclude: the effects that were found.", parameter_blocks(discovery)),
        ("drive", "What to drive next", "The runs that tell look-alikes apart.", experiment_blocks(discovery)),
        ("basis", "How to reproduce", "Step 1, fit: data and noise; options and files.", _basis(discovery, options)),
    )  # fmt: skip
    sections = (
        page.Section(key, title, blocks, about=about, folded=True)
        for key, title, about, made in titles
        if (blocks := tuple(made))
    )
    return page.Document(
        title=f"What the odometry model lacks: {dataset.name}",
        subtitle=dataset.description,
        sections=(_answer(discovery), *sections),
        badges=page.simulated_badge(dataset.simulated),
    )


def _answer(discovery: Discovery) -> page.Section:
    """What was gained and the cause, paths before and after, and the warnings."""
    answer, headline = typeset(tables.answer(discovery)), typeset(discovery.headline)
    # Paths of a few held-out runs, or of training runs where none are held out, by both models
    dataset, training = discovery.dataset, set(discovery.trajectories)
    held_out = [run for run in dataset.trajectories if run.id not in training]
    plain = discovery.plain.model
    models: Models = [(PLAIN, plain), (EXTENDED, discovery.extended.model)]
    if not discovery.extends:
        models = [(DESIGN_ITEM, OdometryModel.of_design(dataset.robot, plain.integration)), (ALONE, plain)]
    doubts = tuple(map(typeset, discovery.notes))
    if discovery.extrapolations:
        doubts = ("Held-out runs drive motions that no training run had: see Errors before and after.", *doubts)
    return page.answer_section(
        answer,
        tuple(_tiles(discovery)),
        paths_before_after(held_out or dataset.trajectories, models, "held-out" if held_out else "training"),
        *([page.Paragraph(headline)] if headline != answer else []),
        page.Callout("Before you rely on it", doubts, "warning" if discovery.extrapolations else "plain"),
    )


def _tiles(discovery: Discovery) -> Iterator[page.Fact]:
    held = tables.decisive(discovery)
    where, gap = "training runs", discovery.gap
    if held is not None:
        where, gap = tables.held_out_runs(discovery, held), held.eq6
        for name, before, after in tables.final_errors(held):
            yield page.Fact(name, f"{before.split()[0]} → {after}" if discovery.extends else before, where)
    before, after, floor = tables.gap_values(gap)
    if discovery.extends:
        note = f"{before} → {after}, floor {floor}; {where}"
        yield page.Fact(f"Gap closed, {tables.METRICS[gap.metric]}", tables.closed_share(gap), note)
    else:
        yield page.Fact(tables.METRICS[gap.metric], before, f"floor {floor}; {where}")
    verdict = tables.verdict_in_words(discovery)
    if discovery.verdict == "unknown" and discovery.effects:
        verdict = "likeliest, but no name is sure"
    elif discovery.verdict == "unknown" and discovery.extends:
        added = "a term without a name" if discovery.has_unnamed_term else "the rate that its class usually loses"
        verdict += f"; {added} closes the gap as shown"
    if discovery.sessions.differences or discovery.sessions.doubts:
        verdict += ", sessions differ" if discovery.sessions.differences else ", sessions not compared"
    if not discovery.effects:
        yield page.Fact("Verdict", discovery.verdict, verdict)
        return
    first, *more = discovery.effects
    names = [name.replace("_", " ") for name in (first.name, *first.confusable_with)]
    cause = " or ".join(names) if len(names) < 3 else f"{names[0]} or {len(names) - 1} others"
    also = f", and {len(more)} more" if more else ""
    yield page.Fact("Cause", f"{cause}{also}", f"{verdict}; weight of the name {tables.weight_in_words(first.weight)}")


def _where(discovery: Discovery) -> Iterator[page.Block]:
    """What the residuals depend on, by command and over covariates."""
    if discovery.where:
        yield tables.dependence_table(discovery.where, "Where the plain matrix fails")
    else:
        yield page.Paragraph("The residuals depend on nothing that was tried by more than noise explains.")
    yield from residual_blocks(discovery)
    yield page.Paragraph(
        "A point is the error of the motion in its bin that explains the residuals best, beside those of the other "
        "bins; the bands hold 95 % of what comes out by chance (omnibench guide reports). What was not recorded, or "
        "hardly varies, has no picture.",
        "note",
    )


def evidence_blocks(discovery: Discovery) -> Iterator[page.Block]:
    """The candidates of each step with their weights, and what is left after all that was added."""
    yield from filter(None, [candidate_grid(discovery)])
    if discovery.left:
        caption = "What the residuals still depend on, after all that was added"
        yield tables.dependence_table(discovery.left, caption)
    elif discovery.effects:
        yield page.Paragraph("With what was added, the residuals depend on nothing that was tried: noise is left.")


def parameter_blocks(discovery: Discovery) -> Iterator[page.Block]:
    """The effects that were found, their physics, doubts and sources, and their parameters."""
    for effect in discovery.effects:
        remarks = (effect.in_doubt and f"In doubt: {effect.in_doubt}.", effect.source and f"Source: {effect.source}.")
        stage = f"{effect.name}: stage {effect.stage} ({tables.STAGES[effect.stage]})"
        yield page.Callout(stage, tuple(filter(None, (effect.physics, *remarks))))
    if discovery.effects:
        yield tables.parameter_table(discovery.effects, discovery.dataset)


def alike_blocks(discovery: Discovery) -> Iterator[page.Block]:
    """Classes of effects that look alike, and how large an effect that was not found could be."""
    classes = tuple(" or ".join(names) for names in discovery.classes)
    if classes:
        yield page.Callout("What these data cannot tell apart", classes)
    if discovery.hidden:
        yield tables.hidden_table(discovery.hidden)
    if discovery.measurements or discovery.not_looked_for:
        yield tables.unseen_table(discovery)


def _errors(discovery: Discovery) -> Iterator[page.Block]:
    yield error_grid(discovery)
    yield tables.gap_table(discovery)
    if discovery.extrapolations:
        yield tables.extrapolation_table(discovery.extrapolations)


def experiment_blocks(discovery: Discovery) -> Iterator[page.Block]:
    """The runs that tell the members of a class apart, with their configs."""
    for number, experiment in enumerate(discovery.experiments, 1):
        yield page.Paragraph(f"To separate {listing(list(experiment.separates))}: {experiment.description}")
        if experiment.commands:
            yield tables.experiment_table(experiment)
            title = f"These runs as a config ({experiment_file(number)}): simulate them before they are driven"
            yield page.Details(title, (page.Code(experiment.config),))


def _basis(discovery: Discovery, options: str) -> Iterator[page.Block]:
    dataset, noise = discovery.dataset, discovery.noise
    position, heading = noise_in_words(noise.noise)
    runs = f"{plural(len(discovery.trajectories), 'run')}, {plural(discovery.poses, 'reference pose')}"
    versions = ", ".join(f"{name} {version}" for name, version in package_versions().items())
    facts = (
        page.Fact("Data set", dataset.name, dataset.source),
        page.Fact("Content (SHA-256)", dataset.hash[:16]),
        page.Fact("Training runs", runs, f"poses left out as outliers: {count(discovery.outliers)}"),
        page.Fact("Noise of positions", position),
        page.Fact("Noise of headings", heading),
        page.Fact("Noise from", noise.source, noise.description),
        page.Fact("Odometry", "exact arcs" if discovery.extended.integration == "arc" else "Euler steps, Eq. (1)"),
        page.Fact("Time", f"{fixed(discovery.seconds, 1)} s"),
        page.Fact("Versions", versions),
    )
    yield page.Facts(facts)
    yield page.Callout("Warnings on reading the data", dataset.warnings, "warning")
    files = "model.yaml is the extended calibration, plain.yaml the matrix alone"
    if not discovery.extends:
        files = "plain.yaml is the matrix, to which nothing was added"
    yield page.Paragraph(f"Beside this report: {files}. All files: omnibench guide discover.")
    yield page.Code(options, "Effective options (config.yaml)")
