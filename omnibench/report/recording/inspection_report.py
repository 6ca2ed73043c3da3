"""The report of an inspection: paths, motions driven, what can be identified, wheel rates, and runs step by step."""

from __future__ import annotations

from omnibench.data.dataset import Dataset
from omnibench.fit.inspect import Inspection
from omnibench.fit.uncertainty.identifiability import UNTOLD
from omnibench.report.blocks import (
    Callout,
    Document,
    Fact,
    Paragraph,
    Section,
    answer_section,
    simulated_badge,
)
from omnibench.report.numbers import count, fixed, listing, significant
from omnibench.report.recording.contents import contents_table
from omnibench.report.recording.driven_motions import (
    DrivenMotion,
    driven_motions,
    missing_in_words,
    motion_figures,
    motion_table,
)
from omnibench.report.recording.inspection_tables import identifiability_table, parameter_table, split_table
from omnibench.report.recording.section import about_table, path_overview, pictures
from omnibench.words import plural


def inspection_document(dataset: Dataset, inspection: Inspection) -> Document:
    """The report as blocks. DataError in one line: scans that cannot be read."""
    training = dataset.split("train") or dataset.trajectories
    motions = driven_motions(training, dataset.robot)
    identified = inspection.identifiability
    return Document(
        title=f"What is in {dataset.name}",
        subtitle=dataset.description,
        sections=(
            _answer(dataset, inspection, motions),
            Section(
                "motions",
                "Motions driven",
                (motion_figures(training, dataset.robot), motion_table(motions)),
                about="By the training runs, from which a calibration is fitted.",
            ),
            Section(
                "identified",
                "What can be identified",
                (
                    *map(Paragraph, _identified_in_words(inspection)),
                    identifiability_table(inspection),
                    *((parameter_table(inspection),) if identified.parameters else ()),
                    Paragraph(f"Noise: {identified.noise_source}.", "note"),
                ),
                about="What a calibration from these runs could know, and what it could not.",
            ),
            *pictures(dataset),
            Section(
                "recorded",
                "What was recorded",
                (split_table(inspection), contents_table(dataset), about_table(dataset)),
                about="Quantities, numbers, intervals, and where the recordings come from.",
                folded=True,
            ),
        ),
        badges=simulated_badge(dataset.simulated),
    )


def _answer(dataset: Dataset, inspection: Inspection, motions: list[DrivenMotion]) -> Section:
    splits = inspection.splits
    names = {"train": "to train", "validation": "held out"}
    parts = " and ".join(f"{of_split.trajectories:,} {names[name]}" for name, of_split in splits.items())
    missing = missing_in_words(motions)
    lacks = f"To train, it was never driven {missing}." if missing else "Every kind of motion was driven to train."
    open_ones = inspection.identifiability.sentences
    told = "Part of the matrix stays open: see below." if open_ones else "The runs determine all of the matrix."
    sentence = f"{plural(inspection.trajectories, 'run')} of {inspection.robot} ({parts}). {lacks} {told}"
    seconds = sum(of_split.duration_s for of_split in splits.values())
    metres = sum(of_split.distance_m for of_split in splits.values())
    tiles = (
        Fact("Runs", count(inspection.trajectories), parts),
        Fact("Driven", f"{significant(metres, 3)} m", f"in {fixed(seconds / 60, 1)} min"),
        Fact(
            "Wheel samples",
            f"every {significant(1e3 * inspection.sample_period_s)} ms",
            count(inspection.wheel_samples),
        ),
        _reference_tile(inspection),
    )
    return answer_section(
        sentence,
        tiles,
        path_overview(dataset),
        Callout("Findings", inspection.findings, "warning" if open_ones else "plain"),
        Callout("Warnings on reading the data", inspection.warnings, "warning"),
    )


def _reference_tile(inspection: Inspection) -> Fact:
    """The reference poses or, where there are none, how many references of which kinds there are."""
    kinds = ", ".join(f"{number} of {kind}" for kind, number in inspection.references.items())
    if inspection.pose_period_s is None:
        return Fact("References", count(sum(inspection.references.values())), kinds)
    every = f"every {significant(1e3 * inspection.pose_period_s)} ms"
    beside = f"; beside them {kinds}" if kinds else ""
    return Fact("Reference poses", every, f"{count(inspection.reference_poses)}{beside}")


def _identified_in_words(inspection: Inspection) -> list[str]:
    """What the runs determine and what they do not, a sentence each."""
    driven = [each for each in inspection.identifiability.directions if each.state == "driven" and each.motion]
    words = []
    for title, wanted in (("Determined", False), ("Determined in part", True)):
        some = [each for each in driven if wanted == any(value > UNTOLD for value in each.deviations or ())]
        motions = list(dict.fromkeys(each.motion.removesuffix(" on the spot") for each in some))
        words += [f"{title}: the columns of the matrix that belong to {listing(motions)}."] if some else []
    return [*words, *(f"{sentence[:1].upper()}{sentence[1:]}." for sentence in inspection.identifiability.sentences)]
