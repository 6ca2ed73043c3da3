"""Published results compared with ours in sentences: which figures agree, which do not, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.compare.report.view import SPLIT_NAMES, THEORETICAL_NAME, DatasetView
from omnibench.compare.report.wording import cost_decimals
from omnibench.compare.result import EntryStatistics, Interval
from omnibench.data.dataset import SPLITS, Split, Trajectory
from omnibench.report.blocks import Block, Callout
from omnibench.report.numbers import fixed, listing, percent, span
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_PUBLISHED_COST = "final_pose"  # published costs are those of Eq. (6)
_SCATTER = 0.75  # share of the calibrated cost: above it the cost is called "mostly" scatter (chosen)


@dataclass(frozen=True)
class Finding:
    """One of our figures compared with the published ones, in a sentence. alike: True where they agree."""

    alike: bool
    words: str


def published_blocks(view: DatasetView) -> tuple[Block, ...]:
    """Our figures compared with the published ones, and reasons why they differ; nothing where none are published."""
    results = view.config.published_results
    if not results:
        return ()
    if view.config.cost.name != _PUBLISHED_COST:
        remark = f"They are of the cost {_PUBLISHED_COST}, Eq. (6); this comparison's is {view.config.cost.name}."
        return (Callout("The published costs cannot be set beside these", (remark,), "warning"),)
    compared = findings(view)
    sources = listing(list(dict.fromkeys(result.source for result in results)))
    return (
        Callout(f"As published ({sources})", tuple(finding.words for finding in compared if finding.alike), "good"),
        Callout(f"Not as published ({sources})", tuple(finding.words for finding in compared if not finding.alike)),
        Callout("Why they are alike, or are not", tuple(_reasons(view))),
    )


def findings(view: DatasetView) -> list[Finding]:
    """Theoretical cost, calibrated cost and improvement on each split; then the change from training to validation."""
    best = view.best
    calibrated = None if best is None or best.calibrator == THEORETICAL_NAME else best
    compared = [finding for split in view.splits for finding in _of_split(view, split, calibrated)]
    return compared + _over_time(view, calibrated)


def _of_split(view: DatasetView, split: Split, best: EntryStatistics | None) -> list[Finding]:
    """Costs before and after calibration, and the improvement, compared with those published for the split."""
    decimals, name = cost_decimals(view), SPLIT_NAMES[split]
    published = _published(view, split)
    if not published:
        return []
    before, after = zip(*published, strict=True)
    compared = []
    if split in view.design_costs:
        compared.append(_compared_cost(f"Theoretical cost, {name}", view.design_costs[split], before, decimals))
    if best is None:
        return compared
    reached, fell = best.cost(split), best.improvement(split)
    if reached is not None:
        compared.append(_compared_cost(f"Calibrated cost, {name} ({best.label})", reached, after, decimals))
    if fell is not None:
        improvements = [1 - low / high for high, low in published]
        compared.append(_compared_improvement(f"Improvement, {name} ({best.label})", fell, improvements))
    return compared


def _compared_cost(what: str, ours: Interval, published: Sequence[float], decimals: int) -> Finding:
    """A cost compared with the published ones: alike where its interval contains one of them."""
    inside = any(ours.low <= value <= ours.high for value in published)
    nearest = min(published, key=lambda value: abs(value - ours.value))
    ratio = ours.value / nearest - 1
    theirs = listing([fixed(value, 4) for value in dict.fromkeys(published)])
    place = "inside the interval" if inside else f"ours is {percent(abs(ratio))} {'above' if ratio > 0 else 'below'}"
    return Finding(
        inside,
        f"{what}: {fixed(ours.value, decimals)} (95 % interval {span(ours.low, ours.high, decimals)}), published "
        f"{theirs}: {place}.",
    )


def _compared_improvement(what: str, ours: Interval, published: Sequence[float]) -> Finding:
    """An improvement compared with the published ones: alike where its interval contains one of them."""
    inside = any(ours.low <= value <= ours.high for value in published)
    nearest = min(published, key=lambda value: abs(value - ours.value))
    points = 100 * (ours.value - nearest)
    theirs = listing([percent(value) for value in dict.fromkeys(published)])
    more = f"ours is {fixed(abs(points), 1)} percentage points {'more' if points > 0 else 'less'}"
    return Finding(
        inside,
        f"{what}: {percent(ours.value)} (95 % interval {span(100 * ours.low, 100 * ours.high, 1)} %), published "
        f"{theirs}: {'inside the interval' if inside else more}.",
    )


def _over_time(view: DatasetView, best: EntryStatistics | None) -> list[Finding]:
    """Findings about the change of the cost from training to validation, before and after calibration."""
    pairs = [[result.costs(split) for split in SPLITS] for result in view.config.published_results]
    published = [(train, validation) for train, validation in pairs if train is not None and validation is not None]
    kinds = (
        ("theoretical", [view.design_costs.get(split) for split in SPLITS], 0),
        ("calibrated", [None if best is None else best.cost(split) for split in SPLITS], 1),
    )
    compared = []
    for name, (train, validation), kind in kinds:
        if train is None or validation is None or not published:
            continue
        change = validation.value / train.value - 1
        changes = [later[kind] / earlier[kind] - 1 for earlier, later in published]
        # Both splits are samples, so that the interval of the change is about that of the two together.
        spread = math.hypot(*((cost.high - cost.low) / 2 / cost.value for cost in (train, validation)))
        inside = any(abs(change - value) <= spread for value in changes)
        theirs = listing([percent(value, signed=True) for value in dict.fromkeys(changes)])
        compared.append(
            Finding(
                inside,
                f"From training to validation the {name} cost changes by {percent(change, signed=True)} (± "
                f"{percent(spread)} by chance), published {theirs}: "
                f"{'within chance' if inside else 'more apart than chance explains'}.",
            )
        )
    return compared


def _published(view: DatasetView, split: Split) -> list[tuple[float, float]]:
    """Published costs of a split before and after calibration, of the results that have both."""
    costs = (result.costs(split) for result in view.config.published_results)
    return [pair for pair in costs if pair is not None]


def _reasons(view: DatasetView) -> list[str]:
    """Reasons, from the data and the config, why our figures differ from the published ones."""
    config, dataset, split = view.config, view.dataset, view.scored
    runs = dataset.split(split)
    origin = "simulated" if dataset.simulated else "recorded by another robot, or at another time"
    reasons = [f"The data are others: these are {origin}, {plural(len(runs), 'run')} for {SPLIT_NAMES[split]}."]
    distance = float(np.mean([_length(run) for run in runs]))
    systematic, _ = _parts(view.design_errors[split], runs)
    theoretical = (
        "The theoretical cost comes from deviations of the wheels from their design values, and grows with the "
        f"distance driven: {fixed(distance, 2)} m a run here; the published lengths are not known."
    )
    if systematic is not None:
        theoretical += f" The design values miss the mean end of a command's runs by {fixed(systematic, 4)} on average."
    reasons.append(theoretical)
    reasons += _floor(view, runs)
    if config.integration == "arc":
        reasons.append("Odometry is by exact arcs here; the published costs are of the Euler steps of Eq. (1).")
    boxes = {entry.box for entry, _ in view.calibrated if entry.parameterisation == "matrix"} - {"paper"}
    if boxes:
        reasons.append("Some entries search a wider box than the published ±10 % of each element; tables name the box.")
    if config.notes:
        reasons.append("What the config's author says of it stands at the top of the report.")
    return reasons


def _floor(view: DatasetView, runs: Sequence[Trajectory]) -> list[str]:
    """The share of the calibrated cost that no matrix could remove: the scatter of repetitions of one command."""
    best = view.best
    if best is None or best.typical is None or best.calibrator == THEORETICAL_NAME:
        return []
    errors, reached = view.errors(best.typical, view.scored), best.cost(view.scored)
    if errors is None or reached is None:
        return []
    _, scatter = _parts(errors, runs)
    if scatter is None:
        return ["No command was repeated, so how much of the calibrated cost is noise cannot be told from the data."]
    share = scatter / reached.value
    published = [after for _, after in _published(view, view.scored)]
    floor = f"floor of {fixed(min(published), 4)}" if published else "floor"
    return [
        f"The calibrated cost is {'mostly ' if share > _SCATTER else 'in part '}scatter: after calibration, "
        f"repetitions of one command end {fixed(scatter, 4)} from their mean ({percent(share, 0)} of the cost), which "
        "no matrix can remove. It can come from the reference, from slip and from the encoders; how large it was where "
        f"the published {floor} comes from is not known."
    ]


def _parts(errors: Array, runs: Sequence[Trajectory]) -> tuple[float | None, float | None]:
    """Systematic part and scatter of final errors (Z, 3), m, m, rad; None where no command was repeated.

    The systematic part is the norm of a command's mean error, the scatter the norm of a run's deviation from it,
    each on average. sqrt(n / (n - 1)) corrects for a mean that is itself estimated from the n runs.
    """
    rows: dict[str, list[int]] = {}
    for index, run in enumerate(runs):
        if run.command is not None:
            rows.setdefault(run.command, []).append(index)
    groups = [errors[chosen] for chosen in rows.values() if len(chosen) > 1]
    if not groups:
        return None, None
    means = [float(np.linalg.norm(group.mean(axis=0))) for group in groups]
    deviations = [
        np.linalg.norm(group - group.mean(axis=0), axis=1) * np.sqrt(len(group) / (len(group) - 1)) for group in groups
    ]
    return float(np.mean(means)), float(np.mean(np.concatenate(deviations)))


def _length(run: Trajectory) -> float:
    """The length of a run, m: as commanded, or else along the reference poses."""
    if run.distance is not None:
        return run.distance
    return float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum())
