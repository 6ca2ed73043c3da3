"""The result in plain words."""

from __future__ import annotations

import numpy as np

from omnibench.compare.results import EntryStatistics
from omnibench.compare.view import SPLIT_NAMES, THEORETICAL_NAME, DatasetView, positions_and_headings
from omnibench.compare.wording import cost, difference_in_words, improvement, interval_in_percent, position_unit
from omnibench.report.blocks import Block, Callout, Fact, Facts, Paragraph
from omnibench.report.numbers import decimals_for, fixed, listing, percent, plural, span


def headline(view: DatasetView) -> tuple[Block, ...]:
    """Which calibrator is best, by how much the error fell and how sure that is, and who is as good."""
    best = view.best
    if best is None or best.calibrator == THEORETICAL_NAME:
        return (Paragraph(_no_winner(view, best), "lead"), _remarks(view, best))
    return (Paragraph(_verdict(view, best), "lead"), Facts(_tiles(view, best), "tiles"), _remarks(view, best))


def _no_winner(view: DatasetView, best: EntryStatistics | None) -> str:
    if best is None:
        return f"No calibrator gave an answer: {plural(len(view.runs), 'run')}, none usable; the reasons are below."
    answers = [entry.label for entry, _ in view.calibrated]
    if not answers:
        return "Only the design values gave an answer; there is no calibration to compare them with."
    return (
        f"No calibrator did better than the design values on the {SPLIT_NAMES[view.scored]} data: {listing(answers)} "
        f"ended above their cost, or level with it."
    )


def _verdict(view: DatasetView, best: EntryStatistics) -> str:
    split = view.scored
    reached, fell, before = cost(best, split), improvement(best, split), view.theoretical_cost(split)
    others = len(view.calibrated) > 1
    text = f"{best.label} is {'best' if others else 'the only calibrator with an answer'}."
    if reached is not None and before is not None:
        text += (
            f" On the {SPLIT_NAMES[split]} data its cost is {fixed(reached.value, 4)}, "
            f"where the design values give {fixed(before, 4)}"
        )
    if fell is not None:
        text += f": the error fell by {percent(fell.value)} (95 % interval {interval_in_percent(fell)})"
        if fell.low <= 0:
            text += ", which the noise alone could explain"
    text += "."
    equal = [entry.label for entry in view.statistics if entry.practically_equal and not entry.is_best]
    if equal:
        text += f" Practically equal to it: {listing(equal)}."
    return text


def _tiles(view: DatasetView, best: EntryStatistics) -> tuple[Fact, ...]:
    split = view.scored
    reached, fell, before = cost(best, split), improvement(best, split), view.theoretical_cost(split)
    tiles = []
    if reached is not None and before is not None:
        tiles.append(
            Fact(
                f"Cost, {SPLIT_NAMES[split]}",
                f"{fixed(before, 4)} → {fixed(reached.value, 4)}",
                f"95 % interval {span(reached.low, reached.high, 4)}",
            )
        )
    if fell is not None:
        tiles.append(Fact("Improvement", percent(fell.value), f"95 % interval {interval_in_percent(fell)}"))
    after = None if best.typical is None else view.errors(best.typical, split)
    if after is not None:
        (p0, h0), (p1, h1) = positions_and_headings(view.design_errors[split]), positions_and_headings(after)
        factor, unit, _ = position_unit(float(p0.mean()), float(p1.mean()))
        digits = max(decimals_for(factor * float(p1.mean()), 3), 0)
        tiles.append(
            Fact(
                "Final position error, mean",
                f"{fixed(factor * p0.mean(), min(digits, 1) if unit == 'mm' else digits)} → "
                f"{fixed(factor * p1.mean(), min(digits, 1) if unit == 'mm' else digits)} {unit}",
                f"worst {fixed(factor * p1.max(), 1 if unit == 'mm' else 3)} {unit}",
            )
        )
        degrees = np.degrees([h0.mean(), h1.mean(), h1.max()])
        tiles.append(
            Fact(
                "Final heading error, mean",
                f"{fixed(degrees[0], 2)}° → {fixed(degrees[1], 2)}°",
                f"worst {fixed(degrees[2], 2)}°",
            )
        )
    return tuple(tiles)


def _remarks(view: DatasetView, best: EntryStatistics | None) -> Callout:
    items = []
    split = view.scored
    if split == "train":
        items.append("There is no validation split: costs and errors are those of the data that were fitted.")
    if best is not None:
        worse = [
            f"{entry.label} ({', '.join(difference_in_words(entry.difference))})"
            for entry, _ in view.calibrated
            if entry.difference is not None and entry.practically_equal is False and not entry.is_best
        ]
        if worse:
            items.append(
                f"Worse than {best.label} by more than the noise, as the mean difference in {SPLIT_NAMES[split]} cost "
                f"with its 95 % interval: {listing(worse)}."
            )
    for entry in view.statistics:
        bad = [run.record for run in view.runs if run.record.label == entry.label and run.matrix is None]
        if bad:
            reasons = listing(list(dict.fromkeys(f"{record.outcome}: {record.reason}" for record in bad)), 2)
            items.append(f"{entry.label} gave no answer in {len(bad)} of {plural(entry.runs, 'run')} ({reasons}).")
    bound = [entry.label for entry, run in view.calibrated if run.record.at_bounds]
    if bound:
        items.append(f"Held back by the box, with elements on a bound: {listing(bound)}. A wider box may do better.")
    return Callout("To be kept in mind", tuple(items), "warning" if any("no answer" in i for i in items) else "plain")
