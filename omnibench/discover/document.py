"""``discovery.json``: the document that ``omnibench discover`` writes and, with --json, prints. SI units."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from omnibench.config import Model
from omnibench.discover.result import (
    Absorbed,
    Candidate,
    CovariateDependence,
    Discovery,
    Experiment,
    Extrapolation,
    Gap,
    HeldOut,
    Hidden,
    NamedEffect,
    Step,
    Verdict,
)
from omnibench.robot.calibration import Noise
from omnibench.robot.effects.effect import Stage


class ParameterEntry(Model):
    """A parameter with its 95 % interval. shape: True if it was chosen among a few values, without an interval."""

    value: float
    unit: str
    low: float | None
    high: float | None
    shape: bool


class EffectEntry(Model):
    """An effect that was found, as result.NamedEffect. gain: its whitened chi-square difference."""

    name: str
    stage: Stage
    weight: float
    parameters: dict[str, ParameterEntry]
    confusable_with: tuple[str, ...]
    physics: str
    source: str
    gain: float
    degrees_of_freedom: int
    in_doubt: str


class CandidateEntry(Model):
    """An effect that was tried at one step, as result.Candidate. gain: its whitened chi-square difference."""

    name: str
    gain: float
    degrees_of_freedom: int
    weight: float


class BeforeAfter(Model):
    """A mean final error of the plain matrix and of the extended model."""

    before: float
    after: float


class HeldOutEntry(Model):
    """Both gaps on runs that no fit has seen."""

    runs: int
    eq6: Gap
    chi2: Gap
    position_m: BeforeAfter
    heading_rad: BeforeAfter


class NotLookedFor(Model):
    """An effect that these data cannot show, and why."""

    name: str
    reason: str


class NoiseEntry(Model):
    """The noise by which all residuals are whitened, as fit.least_squares.noise.NoiseEstimate."""

    components: Noise
    source: str
    degrees_of_freedom: int
    description: str


class DiscoveryDocument(Model):
    """The content of discovery.json; classes of result.py are written as they stand there."""

    verdict: Verdict
    effects: tuple[EffectEntry, ...]
    where: tuple[CovariateDependence, ...]
    absorbed: tuple[str, ...]
    gap: Gap
    held_out: dict[Literal["repetitions", "session"], HeldOutEntry]
    model: str
    plain_model: str
    headline: str
    dataset: str
    dataset_hash: str
    simulated: bool
    left: tuple[CovariateDependence, ...]
    candidates: tuple[tuple[CandidateEntry, ...], ...]
    classes: tuple[tuple[str, ...], ...]
    experiments: tuple[Experiment, ...]  # their configs are files beside this one, too
    measurements: tuple[Absorbed, ...]  # measurements that would identify the absorbed effects
    not_looked_for: tuple[NotLookedFor, ...]
    hidden: tuple[Hidden, ...]
    steps: tuple[Step, ...]
    novelties: tuple[Extrapolation, ...]
    notes: tuple[str, ...]
    noise: NoiseEntry
    runs: int
    poses: int
    outliers: int
    seconds: float


def experiment_file(number: int) -> str:
    """The name of the file of the experiment of that number, the first being 1."""
    return f"experiment-{number}.yaml"


def discovery_document(discovery: Discovery, folder: Path) -> DiscoveryDocument:
    """The document of a discovery. folder: where its calibrations are, or will be."""
    noise = discovery.noise
    return DiscoveryDocument(
        verdict=discovery.verdict,
        effects=tuple(map(_effect, discovery.effects)),
        where=discovery.where,
        absorbed=tuple(each.name for each in discovery.absorbed),
        gap=discovery.gap,
        held_out={held.data: _held_out(held) for held in discovery.held_out},
        model=str((folder / "model.yaml").resolve()),
        plain_model=str((folder / "plain.yaml").resolve()),
        headline=discovery.headline,
        dataset=discovery.dataset.name,
        dataset_hash=discovery.dataset.hash,
        simulated=discovery.dataset.simulated,
        left=discovery.left,
        candidates=tuple(tuple(map(_candidate, step)) for step in discovery.candidates),
        classes=discovery.classes,
        experiments=discovery.experiments,
        measurements=discovery.absorbed,
        not_looked_for=tuple(NotLookedFor(name=name, reason=reason) for name, reason in discovery.not_looked_for),
        hidden=discovery.hidden,
        steps=discovery.steps,
        novelties=discovery.extrapolations,
        notes=discovery.notes,
        noise=NoiseEntry(
            components=noise.noise,
            source=noise.source,
            degrees_of_freedom=noise.degrees_of_freedom,
            description=noise.description,
        ),
        runs=len(discovery.trajectories),
        poses=discovery.poses,
        outliers=discovery.outliers,
        seconds=discovery.seconds,
    )


def _effect(effect: NamedEffect) -> EffectEntry:
    return EffectEntry(
        name=effect.name,
        stage=effect.stage,
        weight=effect.weight,
        parameters={
            each.name: ParameterEntry(
                value=each.value,
                unit=each.unit,
                low=None if each.shape else each.low,
                high=None if each.shape else each.high,
                shape=each.shape,
            )
            for each in effect.parameters
        },
        confusable_with=effect.confusable_with,
        physics=effect.physics,
        source=effect.source,
        gain=effect.chi_square,
        degrees_of_freedom=effect.degrees_of_freedom,
        in_doubt=effect.in_doubt,
    )


def _candidate(candidate: Candidate) -> CandidateEntry:
    return CandidateEntry(
        name=candidate.name,
        gain=candidate.chi_square,
        degrees_of_freedom=candidate.degrees_of_freedom,
        weight=candidate.weight,
    )


def _held_out(held: HeldOut) -> HeldOutEntry:
    position, heading = held.position_m, held.heading_rad
    return HeldOutEntry(
        runs=held.runs,
        eq6=held.eq6,
        chi2=held.chi2,
        position_m=BeforeAfter(before=position[0], after=position[1]),
        heading_rad=BeforeAfter(before=heading[0], after=heading[1]),
    )
