"""Our tables beside those that were published: what is alike, what is not, and why, in words made of the figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from omnibench.compare.report.view import SPLIT_NAMES, THEORETICAL_NAME, DatasetView
from omnibench.compare.report.wording import cost, cost_decimals, improvement
from omnibench.compare.result import EntryStatistics, Interval
from omnibench.data.dataset import SPLITS, Split, Trajectory
from omnibench.report.blocks import Block, Callout
from omnibench.report.numbers import fixed, listing, percent, span
from omnibench.robot.kinematics import Array

_PUBLISHED_COST = "final_pose"  # Eq. (6), which the published costs are of
_SCATTER = 0.75  # a share of the calibrated cost that is "mostly" scatter


@dataclass(frozen=True)
class Finding:
    """One figure of ours beside those published, in words."""

    alike: bool
    words: str


def published_blocks(view: DatasetView) -> tuple[Block, ...]:
    """Each of our figures beside those published, and what the data say of why they differ; none without any."""
    results = view.config.published_results
    if not results:
        return ()
    if view.config.cost.name != _PUBLISHED_COST:
        remark = f"They are of the cost {_PUBLISHED_COST}, Eq. (6); this comparison's is {view.config.cost.name}."
        return (Callout("The published costs cannot be set beside these", (remark,), "warning"),)
    found = findings(view)
    sources = listing(list(dict.fromkeys(result.source for result in results)))
    return (
        Callout(f"As published ({sources})", tuple(each.words for each in found if each.alike), "good"),
        Callout(f"Not as published ({sources})", tuple(each.words for each in found if not each.alike)),
        Callout("Why they are alike, or are not", tuple(_reasons(view))),
    )


def findings(view: DatasetView) -> list[Finding]:
    """Theoretical cost, calibrated cost and improvement of each split; then how the second split differs."""
    best = view.best
    calibrated = None if best is None or best.calibrator == THEORETICAL_NAME else best
    found = []
    for split in SPLITS:
        if split in view.design_errors:
            found += _of_split(view, split, calibrated)
    return found + _over_time(view, calibrated)


def _of_split(view: DatasetView, split: Split, best: EntryStatistics | None) -> list[Finding]:
    """Our cost before and after calibration, and the improvement, against what was published of that split."""
    decimals, name = cost_decimals(view), SPLIT_NAMES[split]
    before, after = _published(view, split, "before"), _published(view, split, "after")
    ours = None if view.theoretical is None else cost(view.theoretical, split)
    found = []
    if ours is not None and before:
        found.append(_beside(f"Theoretical cost, {name}", ours, before, decimals))
    if best is None:
        return found
    reached, fell = cost(best, split), improvement(best, split)
    if reached is not None and after:
        found.append(_beside(f"Calibrated cost, {name} ({best.label})", reached, after, decimals))
    if fell is not None and after:
        gains = [1 - low / high for high, low in zip(before, after, strict=True)]
        found.append(_gain(f"Improvement, {name} ({best.label})", fell, gains))
    return found


def _beside(what: str, ours: Interval, published: Sequence[float], decimals: int) -> Finding:
    """A cost beside those published; alike where the interval holds one of them."""
    inside = any(ours.low <= value <= ours.high for value in published)
    nearest = min(published, key=lambda value: abs(value - ours.value))
    ratio = ours.value / nearest - 1
    told = listing([fixed(value, 4) for value in dict.fromkeys(published)])
    place = "inside the interval" if inside else f"ours is {percent(abs(ratio))} {'above' if ratio > 0 else 'below'}"
    return Finding(
        inside,
        f"{what}: {fixed(ours.value, decimals)} (95 % interval {span(ours.low, ours.high, decimals)}), published "
        f"{told}: {place}.",
    )


def _gain(what: str, ours: Interval, published: Sequence[float]) -> Finding:
    """An improvement beside those published."""
    inside = any(ours.low <= value <= ours.high for value in published)
    nearest = min(published, key=lambda value: abs(value - ours.value))
    points = 100 * (ours.value - nearest)
    told = listing([percent(value) for value in dict.fromkeys(published)])
    more = f"ours is {fixed(abs(points), 1)} percentage points {'more' if points > 0 else 'less'}"
    return Finding(
        inside,
        f"{what}: {percent(ours.value)} (95 % interval {span(100 * ours.low, 100 * ours.high, 1)} %), published "
        f"{told}: {'inside the interval' if inside else more}.",
    )


def _over_time(view: DatasetView, best: EntryStatistics | None) -> list[Finding]:
    """How the cost changes from training to validation, before and after calibration."""
    found = []
    kinds: tuple[tuple[str, Literal["before", "after"], EntryStatistics | None], ...] = (
        ("theoretical", "before", view.theoretical),
        ("calibrated", "after", best),
    )
    for name, kind, entry in kinds:
        theirs = [_published(view, split, kind) for split in SPLITS]
        ours = [None if entry is None else cost(entry, split) for split in SPLITS]
        train, validation = ours
        if train is None or validation is None or not all(theirs):
            continue
        change = validation.value / train.value - 1
        changes = [later / earlier - 1 for earlier, later in zip(*theirs, strict=True)]
        # Both splits are drawn anew: the interval of the change is about that of both together.
        spread = math.hypot(*((each.high - each.low) / 2 / each.value for each in (train, validation)))
        inside = any(abs(change - value) <= spread for value in changes)
        told = listing([percent(value, signed=True) for value in dict.fromkeys(changes)])
        found.append(
            Finding(
                inside,
                f"From training to validation the {name} cost changes by {percent(change, signed=True)} (± "
                f"{percent(spread)} by chance), published {told}: "
                f"{'within chance' if inside else 'more apart than chance explains'}.",
            )
        )
    return found


def _published(view: DatasetView, split: Split, kind: Literal["before", "after"]) -> list[float]:
    """Published costs of a split, of the results that have both."""
    values = []
    for result in view.config.published_results:
        before = result.theoretical_train_cost if split == "train" else result.theoretical_validation_cost
        after = result.train_cost if split == "train" else result.validation_cost
        if before is not None and after is not None:
            values.append(before if kind == "before" else after)
    return values


def _reasons(view: DatasetView) -> list[str]:
    """What the data and the config can say of why figures differ from those published."""
    config, dataset, split = view.config, view.dataset, view.scored
    runs = dataset.split(split)
    origin = "simulated" if dataset.simulated else "recorded by another robot, or at another time"
    reasons = [f"The data are others: these are {origin}, {len(runs)} runs for {SPLIT_NAMES[split]}."]
    way = float(np.mean([_way(run) for run in runs]))
    systematic, _ = _parts(view.design_errors[split], runs)
    told = (
        "The theoretical cost comes from what the wheels differ from their design values, and grows with the way: "
        f"{fixed(way, 2)} m a run here; the published lengths are not known."
    )
    if systematic is not None:
        told += f" The design values miss the mean end of a command's runs by {fixed(systematic, 4)} on average."
    reasons.append(told)
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
    """How much of the calibrated cost no matrix could remove, because repetitions of one command differ so much."""
    best = view.best
    if best is None or best.typical is None or best.calibrator == THEORETICAL_NAME:
        return []
    errors, reached = view.errors(best.typical, view.scored), cost(best, view.scored)
    if errors is None or reached is None:
        return []
    _, scatter = _parts(errors, runs)
    if scatter is None:
        return ["No command was repeated, so how much of the calibrated cost is noise cannot be told from the data."]
    share = scatter / reached.value
    published = _published(view, view.scored, "after")
    floor = f"floor of {fixed(min(published), 4)}" if published else "floor"
    return [
        f"The calibrated cost is {'mostly ' if share > _SCATTER else 'in part '}scatter: after calibration, "
        f"repetitions of one command end {fixed(scatter, 4)} from their mean ({percent(share, 0)} of the cost), which "
        "no matrix can remove. It can come from the reference, from slip and from the encoders; how large it was where "
        f"the published {floor} comes from is not known."
    ]


def _parts(errors: Array, runs: Sequence[Trajectory]) -> tuple[float | None, float | None]:
    """The norm of a command's mean final error, and of what its runs differ from it, on average; None: no repetitions.

    errors (Z, 3): m, m, rad, of which Eq. (6) takes the norm. The scatter is that about the true mean.
    """
    rows: dict[str, list[int]] = {}
    for index, run in enumerate(runs):
        if run.command is not None:
            rows.setdefault(run.command, []).append(index)
    groups = [errors[chosen] for chosen in rows.values() if len(chosen) > 1]
    if not groups:
        return None, None
    means = [float(np.linalg.norm(group.mean(axis=0))) for group in groups]
    about = [
        np.linalg.norm(group - group.mean(axis=0), axis=1) * np.sqrt(len(group) / (len(group) - 1)) for group in groups
    ]
    return float(np.mean(means)), float(np.mean(np.concatenate(about)))


def _way(run: Trajectory) -> float:
    """The commanded length, m; where that is not known, the length along the reference poses."""
    if run.distance is not None:
        return run.distance
    return float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum())
