"""The section on the result: the verdict in a sentence, the main figures, and what to keep in mind."""

from __future__ import annotations

from typing import Literal

import numpy as np

from omnibench.compare.report.view import SPLIT_NAMES, DatasetView
from omnibench.compare.report.wording import (
    NO_INTERVAL,
    cost_decimals,
    difference_in_words,
    improvement_in_words,
    interval_in_words,
    on_bounds,
    position_unit,
)
from omnibench.compare.result import THEORETICAL_NAME, EntryStatistics
from omnibench.fit.evaluate import positions_and_headings
from omnibench.report.blocks import Block, Callout, Fact, Facts, Paragraph, Section
from omnibench.report.numbers import fixed, listing, percent, span
from omnibench.words import plural

_ARRIVED = 0.01  # relative: a search whose training cost is further above the lowest one missed the minimum (chosen)
# Share of the interval's width: seeds whose costs differ by more are worth a remark (chosen).
_SEEDS_DIFFER = 0.25


def result_section(view: DatasetView) -> Section:
    """The section with the result: the best calibrator, its improvement with an interval, and equally good ones."""
    return Section("result", "Result", _blocks(view))


def _blocks(view: DatasetView) -> tuple[Block, ...]:
    best = view.best
    said = _held_out(view)
    if best is None or best.calibrator == THEORETICAL_NAME:
        return (Paragraph(_no_winner(view, best), "lead"), *said, _remarks(view, best))
    return (Paragraph(_verdict(view, best), "lead"), Facts(_tiles(view, best), "tiles"), *said, _remarks(view, best))


def _held_out(view: DatasetView) -> tuple[Block, ...]:
    """The verdict of held-out runs on the best calibration, in the words of ``calibrate`` and ``evaluate``."""
    sessions = (Callout("Sessions", view.sessions, "warning"),) if view.sessions else ()
    if view.held_out is None:
        return sessions
    verdict = view.held_out.verdict
    manner: Literal["plain", "warning"] = "plain" if verdict.verdict == "better" else "warning"
    return (Callout(f"{view.held_out.label}, {verdict.sentence}", (verdict.detail,), manner), *sessions)


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
    split, decimals = view.scored, cost_decimals(view)
    reached, before = best.cost(split), view.theoretical_cost(split)
    words = f"{_standing(view, best)}."
    if reached is not None and before is not None:
        words += (
            f" On the {SPLIT_NAMES[split]} data its cost is {fixed(reached.value, decimals)}, where the design values "
            f"give {fixed(before, decimals)}"
        )
        interval = best.improvement(split)
        if interval is not None:
            fell, sure = improvement_in_words(best, split, 1)
            words += f": the error fell by {fell}{_with_interval(sure)}, {view.units[split].words}"
            chance = interval.known is not None and interval.holds(0.0)
            words += ", which the noise alone could explain" if chance else ""
        words += "."
    return words


def _standing(view: DatasetView, best: EntryStatistics) -> str:
    """The best entry, in words; where several are level, the lowest training cost decides."""
    if len(view.calibrated) == 1:
        return f"{best.label} is the only calibrator with an answer"
    if view.undecided:
        return (
            f"Which entry is best cannot be said ({view.units[view.scored].words}); {best.label} has the lowest "
            "training cost"
        )
    level = [entry.label for entry in view.level]
    if len(level) == 1:
        return f"{best.label} is best"
    return (
        f"{_number(len(level))} entries are level on the {SPLIT_NAMES[view.scored]} data: {listing(level, 20)}; "
        f"{best.label} has the lowest training cost of them"
    )


def _number(number: int) -> str:
    words = ("Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine", "Ten", "Eleven", "Twelve")
    return words[number - 2] if number <= 12 else str(number)


def _tiles(view: DatasetView, best: EntryStatistics) -> tuple[Fact, ...]:
    split, decimals = view.scored, cost_decimals(view)
    reached, before = best.cost(split), view.theoretical_cost(split)
    tiles = []
    if reached is not None:
        tiles.append(
            Fact(
                f"Cost, {SPLIT_NAMES[split]}",
                f"{fixed(before, decimals)} → {fixed(reached.value, decimals)}",
                _with_interval(interval_in_words(reached, decimals)),
            )
        )
    if best.improvement(split) is not None:
        fell, sure = improvement_in_words(best, split, 1)
        tiles.append(Fact("Improvement", fell, _with_interval(sure)))
    after = None if best.typical is None else view.errors(best.typical, split)
    if after is not None:
        (p0, h0), (p1, h1) = positions_and_headings(view.design_errors[split]), positions_and_headings(after)
        factor, unit, digits = position_unit(float(p0.mean()), float(p1.mean()))
        tiles += [
            Fact(
                "Final position error, mean",
                f"{fixed(factor * p0.mean(), digits)} → {fixed(factor * p1.mean(), digits)} {unit}",
                f"worst {fixed(factor * p1.max(), digits)} {unit}",
            ),
            Fact(
                "Final heading error, mean",
                f"{fixed(np.degrees(h0.mean()), 2)}° → {fixed(np.degrees(h1.mean()), 2)}°",
                f"worst {fixed(np.degrees(h1.max()), 2)}°",
            ),
        ]
    return tuple(tiles)


def _with_interval(words: str) -> str:
    return "" if words == NO_INTERVAL else f" (95 % interval {words})"


def _doubts(view: DatasetView, best: EntryStatistics) -> list[str]:
    """Reasons to doubt the first place: seeds that differ, a minimum that was missed, others with a lower cost."""
    doubts = []
    split, decimals = view.scored, cost_decimals(view)
    runs = [run for run in view.runs if run.record.label == best.label]
    values = [run.scores[split].cost for run in runs if split in run.scores]
    reached = best.cost(split)
    low, high = (None if reached is None else reached.known) or (0.0, 0.0)
    width = high - low
    if len(values) > 1 and max(values) - min(values) > _SEEDS_DIFFER * width:
        doubts.append(
            f"{best.label} depends on its seed: over {len(values)} seeds its {SPLIT_NAMES[split]} cost goes from "
            f"{span(min(values), max(values), decimals)}. The verdict is about the run of median training cost."
        )
    lowest = min((entry.train_median for entry in view.statistics if entry.train_median is not None), default=None)
    if best.train_median is not None and lowest and best.train_median > (1 + _ARRIVED) * lowest:
        doubts.append(
            f"{best.label} has not found the minimum: its training cost is {percent(best.train_median / lowest - 1)} "
            "above the lowest. That it does better on other data may be chance, or the splits differ in more than "
            "noise."
        )
    lower = _apart(view, -1)
    if lower:
        doubts.append(
            f"Below {best.label} in {SPLIT_NAMES[split]} cost, as the mean difference with its 95 % interval, though "
            f"above it in training cost: {listing(lower, 20)}."
        )
    return doubts


def _apart(view: DatasetView, sign: Literal[-1, 1]) -> list[str]:
    """Entries whose cost is below (-1) or above (1) the best entry's by more than the noise, with the difference."""
    return [
        "{}: {} ({})".format(entry.label, *difference_in_words(entry.difference))
        for entry, _ in view.calibrated
        if entry.difference is not None and entry.practically_equal is False and sign * entry.difference.value > 0
    ]


def _worse_commands(view: DatasetView, best: EntryStatistics) -> list[str]:
    """Commands on which the best entry does worse than the design values, the worst first."""
    if best.typical is None or best.calibrator == THEORETICAL_NAME:
        return []
    split, run = view.scored, best.typical
    before, after = run.design[split].costs, run.scores[split].costs
    rows: dict[str, list[int]] = {}
    for index, trajectory in enumerate(view.dataset.split(split)):
        if trajectory.command is not None:
            rows.setdefault(trajectory.command, []).append(index)
    means = [(name, float(before[chosen].mean()), float(after[chosen].mean())) for name, chosen in rows.items()]
    worse = sorted((row for row in means if row[2] > row[1]), key=lambda row: row[1] - row[2])
    if not worse:
        return []
    digits = cost_decimals(view)
    changes = [f"{name} {fixed(was, digits)} → {fixed(now, digits)}" for name, was, now in worse]
    return [
        f"{best.label} does worse than the design values on {len(worse)} of {plural(len(means), 'command')} of the "
        f"{SPLIT_NAMES[split]} data, as the mean cost of each, design values → {best.label}: "
        f"{listing(changes, len(changes))}."
    ]


def _repeats_commands(view: DatasetView) -> bool:
    commands = [trajectory.command for trajectory in view.dataset.split(view.scored) if trajectory.command is not None]
    return len(set(commands)) < len(commands)


def _remarks(view: DatasetView, best: EntryStatistics | None) -> Callout:
    items: list[str] = []
    doubts: list[str] = []
    split = view.scored
    if split == "train":
        items.append("There is no validation split: costs and errors are those of the data that were fitted.")
    if best is not None:
        doubts = _doubts(view, best) + _worse_commands(view, best)
        items += doubts
        worse = _apart(view, 1)
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
    bound = [entry.label for entry, run in view.calibrated if on_bounds(run.record)]
    if bound:
        items.append(f"Held back by the box, with elements on a bound: {listing(bound)}. A wider box may do better.")
    if view.units[split].name == "run" and _repeats_commands(view):
        items.append(
            "The intervals are over runs like these. Runs of one command share what the model misses there, so for "
            "commands that were not driven here the spread is larger (bootstrap: {unit: command})."
        )
    failed = any(entry.answers < entry.runs for entry in view.statistics)
    return Callout("To be kept in mind", tuple(items), "warning" if doubts or failed else "plain")
