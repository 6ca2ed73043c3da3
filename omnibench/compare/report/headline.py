"""The answer of a comparison: a sentence, the main figures, paths before and after, all entries, doubts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.config import THEORETICAL_NAME
from omnibench.compare.report import view as views
from omnibench.compare.result import EntryStatistics
from omnibench.fit.cost import NO_ERROR
from omnibench.fit.evaluate import positions_and_headings
from omnibench.fit.intervals import Interval
from omnibench.report import blocks
from omnibench.report.figures import joined, line, marks
from omnibench.report.numbers import fixed, listing, percent, significant, span, typeset, with_unit
from omnibench.report.path_pictures import CALIBRATED, paths_before_after
from omnibench.report.style import INK, PALETTE, QUIET, plot, text, wrapped
from omnibench.words import plural

_ROW, _LINE = 11, 14  # px of an entry, and of each line of its label
_BEST = blocks.LegendItem("best", "best", PALETTE[0])
_OTHER = blocks.LegendItem("other", "differs by more than chance", PALETTE[1])
_OPEN = blocks.LegendItem("open", "not told apart", QUIET)


@dataclass(frozen=True)
class _Line:
    label: str
    cost: Interval
    item: blocks.LegendItem


def entry_chart(view: views.DatasetView) -> blocks.FigureGrid | None:
    """Every entry's cost on the scored split, the lowest on top; None where no entry was calibrated."""
    lines = _lines(view)
    if not lines:
        return None
    design = view.design_costs.get(view.scored)
    if design is not None:
        lines.append(_Line("design values", design, views.THEORETICAL_STYLE))
    decimals = views.cost_decimals(view)
    items = [
        item for item in (_BEST, _OTHER, _OPEN, views.THEORETICAL_STYLE) if any(each.item is item for each in lines)
    ]
    traces = [trace for item in items for trace in _traces(item, lines, decimals)]
    split = views.SPLIT_NAMES[view.scored]
    figure = plot(*traces, x_title=f"cost of the {split} runs")
    reach = max(max(each.cost.known or (each.cost.value,)) for each in lines)
    figure.update_xaxes(range=[0.0, 1.04 * reach])
    names = [text(wrapped(each.label)) for each in lines]
    height = 70 + (_ROW + _LINE * max(1 + name.count("<br>") for name in names)) * len(lines)
    ends = {"range": [len(lines) - 0.4, -0.6], "tickvals": list(range(len(lines))), "ticktext": names}
    figure.update_yaxes(**ends, ticks="", tickfont_color=INK, showgrid=False)
    words = ", ".join(f"{each.label} {fixed(each.cost.value, decimals)}" for each in lines)
    title = f"All entries: cost of the {split} runs, with 95 % intervals"
    silent = [entry.label for entry in view.statistics if not entry.answers and entry.calibrator != THEORETICAL_NAME]
    caption = (
        f"The lower, the better. Lines: 95 % intervals, {views.interval_basis(view, view.scored)}; whether entries "
        "differ is judged from paired differences, which is finer. An entry stands with its run of median training "
        "cost." + (f" Without an answer: {', '.join(silent)}." if silent else "")
    )
    return blocks.FigureGrid(
        (blocks.Figure(title, figure, f"{title}: {words}", height),), tuple(items), 1, caption, "all-entries"
    )


def _lines(view: views.DatasetView) -> list[_Line]:
    lines = []
    for entry, _ in view.calibrated:
        cost = entry.cost(view.scored)
        if cost is not None:
            best = entry.is_best and not view.undecided
            item = _BEST if best else _OTHER if entry.practically_equal is False else _OPEN
            lines.append(_Line(entry.label, cost, item))
    return sorted(lines, key=lambda each: each.cost.value)


def _traces(item: blocks.LegendItem, lines: Sequence[_Line], decimals: int) -> list[go.Scatter]:
    rows = [(row, each) for row, each in enumerate(lines) if each.item is item]
    spans = [np.column_stack([each.cost.known, [row, row]]) for row, each in rows if each.cost.known is not None]
    words = [
        f"{each.label}: {fixed(each.cost.value, decimals)} ({views.interval_in_words(each.cost, decimals)})"
        for _, each in rows
    ]
    values, places = [each.cost.value for _, each in rows], [float(row) for row, _ in rows]
    dots = marks(item, 10, values, places, hover="%{text}", words=words)
    return [*([line(item, 2.5, *joined(spans).T, line_dash="solid")] if spans else []), dots]


_ARRIVED = 0.01  # relative: a search whose training cost is further above the lowest one missed the minimum (chosen)
# Share of the interval's width: seeds whose costs differ by more are worth a remark (chosen).
_SEEDS_DIFFER = 0.25


def answer_of(view: views.DatasetView) -> blocks.Section:
    """The section with the answer: what calibration gained, paths before and after, all entries, and doubts."""
    best = view.best
    chart = entry_chart(view)
    more: list[blocks.Block] = [*_held_out(view), _remarks(view, best)]
    if best is None or best.calibrator == THEORETICAL_NAME:
        drawn = None if best is None else path_picture(view)
        return blocks.answer_section(_no_winner(view, best), (), drawn, *((chart,) if chart else ()), *more)
    standing = blocks.Paragraph(_standing_at_length(view, best))
    return blocks.answer_section(
        _verdict(view, best), _tiles(view, best), path_picture(view), *((chart,) if chart else ()), standing, *more
    )


def path_picture(view: views.DatasetView) -> blocks.FigureGrid | None:
    """Paths of a few runs of the scored split: reference, design values and the best calibration."""
    models = [(views.THEORETICAL_STYLE, view.model(view.design_matrix))]
    best = view.best
    if best is not None and best.calibrator != THEORETICAL_NAME and best.typical is not None:
        run = best.typical
        if run.matrix is not None:
            style = blocks.LegendItem("calibrated", f"calibrated by {best.label}", CALIBRATED)
            models.append((style, view.model(run.matrix, run.result.extension)))
    return paths_before_after(view.dataset.split(view.scored), models, views.SPLIT_NAMES[view.scored])


def _held_out(view: views.DatasetView) -> tuple[blocks.Block, ...]:
    """The verdict of held-out runs on the best calibration, in the words of ``calibrate`` and ``evaluate``."""
    sessions = (blocks.Callout("Sessions", view.sessions, "warning"),) if view.sessions else ()
    if view.held_out is None:
        return sessions
    verdict = view.held_out.verdict
    manner: Literal["plain", "warning"] = "plain" if verdict.verdict == "better" else "warning"
    words = typeset(f"{view.held_out.label}, {verdict.sentence}")
    return (blocks.Callout(words, (typeset(verdict.detail),), manner), *sessions)


def _no_winner(view: views.DatasetView, best: EntryStatistics | None) -> str:
    if best is None:
        return f"No calibrator gave an answer: {plural(len(view.runs), 'run')}, none usable; the reasons are below."
    answers = [entry.label for entry, _ in view.calibrated]
    if not answers:
        return "Only the design values gave an answer; there is no calibration to compare them with."
    return (
        f"No calibrator did better than the design values on the {views.SPLIT_NAMES[view.scored]} runs: "
        f"{listing(answers)} ended above their cost, or are not told apart from them."
    )


def _verdict(view: views.DatasetView, best: EntryStatistics) -> str:
    split = view.scored
    runs = plural(len(view.dataset.split(split)), f"{views.SPLIT_NAMES[split]} run")
    errors = _errors(view, best)
    words = f"On the {runs}, "
    if errors is not None:
        before, after = errors
        ends = f"ends {after} from the reference, where the design values end {before} off"
        if view.without_poses:
            ends = f"misses the references by {after}, where the design values miss them by {before}"
        words += f"the odometry calibrated by {best.label} {ends}"
    else:
        words += f"{best.label} has the best calibration"
    interval = best.improvement(split)
    if interval is not None:
        fell, sure = views.improvement_in_words(best, split, 1)
        words += f": the cost fell by {fell}{_with_interval(sure)}"
        chance = interval.known is not None and interval.holds(0.0)
        words += ", which the noise alone could explain" if chance else ""
    return f"{words}. {_standing(view, best)}."


def _errors(view: views.DatasetView, best: EntryStatistics) -> tuple[str, str] | None:
    """Mean final errors in words, by the design values and by the best entry: position and heading, where known."""
    parts = list(_changes(view, best))
    if not parts:
        return None
    before, after = zip(*(words for words, _ in parts), strict=True)
    return " and ".join(before), " and ".join(after)


def _changes(view: views.DatasetView, best: EntryStatistics) -> Iterator[tuple[tuple[str, str], str]]:
    """Mean errors of positions, then of headings, before and after calibration, and the worst one after, in words."""
    after = None if best.typical is None else view.errors(best.typical, view.scored)
    if after is None:
        return
    (p0, h0), (p1, h1) = positions_and_headings(view.design_errors[view.scored]), positions_and_headings(after)
    factor, unit, digits = views.position_unit(views.mean_and_worst(p0)[0], views.mean_and_worst(p1)[0])
    for was, now, scale, decimals, of_scale in (
        (p0, p1, factor, digits, unit),
        (h0, h1, math.degrees(1.0), 2, "°"),
    ):
        (mean, worst), (before, _) = views.mean_and_worst(now), views.mean_and_worst(was)
        old, new, most = (with_unit(fixed(scale * value, decimals), of_scale) for value in (before, mean, worst))
        if not math.isnan(mean):
            yield (old, new), most


def _standing(view: views.DatasetView, best: EntryStatistics) -> str:
    """The best entry beside the others, in short."""
    if len(view.calibrated) == 1:
        return f"{best.label} is the only calibrator with an answer"
    if view.undecided:
        return f"Which entry is best cannot be said ({view.units[view.scored].ratio_words})"
    others = len(view.not_told_apart) - 1
    if not others:
        return f"{best.label} is best"
    entries = "other entry is" if others == 1 else "other entries are"
    design = any(entry.calibrator == THEORETICAL_NAME for entry in view.not_told_apart)
    words = ("One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine", "Ten", "Eleven", "Twelve")
    number = words[others - 1] if others <= 12 else str(others)
    return f"{number} {entries} not told apart from it{', the design values among them' if design else ''}"


def _standing_at_length(view: views.DatasetView, best: EntryStatistics) -> str:
    """The entries that are not told apart from the best one; of these the lowest training cost decides."""
    basis = f"The intervals: {view.units[view.scored].ratio_words}."
    if len(view.calibrated) > 1 and view.undecided:
        return f"{best.label} has the lowest training cost. {basis}"
    rivals = [
        "the design values" if entry.calibrator == THEORETICAL_NAME else entry.label for entry in view.not_told_apart
    ]
    if len(rivals) < 2:
        return basis
    return (
        f"Not told apart on the {views.SPLIT_NAMES[view.scored]} runs: {listing(rivals, 20)}; {best.label} has the "
        f"lowest training cost of them. {basis}"
    )


def _tiles(view: views.DatasetView, best: EntryStatistics) -> tuple[blocks.Fact, ...]:
    split, decimals = view.scored, views.cost_decimals(view)
    reached, before = best.cost(split), view.theoretical_cost(split)
    tiles = []
    for (old, new), worst in _changes(view, best):
        kind = "heading" if worst.endswith("°") else "position"
        name = f"Final {kind} error, mean"
        if view.without_poses:
            name = f"Error of {'angles' if kind == 'heading' else 'lengths and places'}, mean"
        shared = old if kind == "heading" else old.rpartition(" ")[0]
        tiles.append(blocks.Fact(name, f"{shared} → {new}", f"worst {worst}"))
    if reached is not None:
        tiles.append(
            blocks.Fact(
                f"Cost, {views.SPLIT_NAMES[split]} runs",
                f"{fixed(before, decimals)} → {fixed(reached.value, decimals)}",
                _with_interval(views.interval_in_words(reached, decimals)).strip(" ()"),
            )
        )
    if best.improvement(split) is not None:
        fell, sure = views.improvement_in_words(best, split, 1)
        tiles.append(blocks.Fact("Improvement of the cost", fell, _with_interval(sure).strip(" ()")))
    return tuple(tiles)


def _with_interval(words: str) -> str:
    return "" if words == views.NO_INTERVAL else f" (95 % interval {words})"


def _doubts(view: views.DatasetView, best: EntryStatistics) -> list[str]:
    """Reasons to doubt the first place: seeds that differ, a minimum that was missed, others with a lower cost."""
    doubts = []
    split, decimals = view.scored, views.cost_decimals(view)
    runs = [run for run in view.runs if run.record.label == best.label]
    values = [run.scores[split].cost for run in runs if split in run.scores]
    reached = best.cost(split)
    low, high = (None if reached is None else reached.known) or (0.0, 0.0)
    width = high - low
    if len(values) > 1 and max(values) - min(values) > _SEEDS_DIFFER * width:
        doubts.append(
            f"{best.label} depends on its seed: over {len(values)} seeds its {views.SPLIT_NAMES[split]} cost goes from "
            f"{span(min(values), max(values), decimals)}. The verdict is about the run of median training cost."
        )
    lowest = min((entry.train_median for entry in view.statistics if entry.train_median is not None), default=None)
    if best.train_median is not None and lowest is not None and best.train_median > (1 + _ARRIVED) * lowest + NO_ERROR:
        above = f"{percent(best.train_median / lowest - 1)} above the lowest"
        if lowest <= NO_ERROR:
            above = f"{significant(best.train_median, 2)}, where the lowest leaves no error"
        doubts.append(
            f"{best.label} has not found the minimum: its training cost is {above}. That it does better on other data "
            "may be chance, or the splits differ in more than noise."
        )
    lower = _apart(view, -1)
    if lower:
        doubts.append(
            f"Below {best.label} in {views.SPLIT_NAMES[split]} cost, as the mean difference with its 95 % interval, "
            f"though above it in training cost: {listing(lower, 20)}."
        )
    return doubts


def _apart(view: views.DatasetView, sign: Literal[-1, 1]) -> list[str]:
    """Entries whose cost is below (-1) or above (1) the best entry's by more than the noise, with the difference."""
    return [
        "{}: {} ({})".format(entry.label, *views.difference_in_words(entry.difference))
        for entry, _ in view.calibrated
        if entry.difference is not None and entry.practically_equal is False and sign * entry.difference.value > 0
    ]


def _worse_commands(view: views.DatasetView, best: EntryStatistics) -> list[str]:
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
    digits = views.cost_decimals(view)
    changes = [f"{name} {fixed(was, digits)} → {fixed(now, digits)}" for name, was, now in worse]
    return [
        f"{best.label} does worse than the design values on {len(worse)} of {plural(len(means), 'command')} of the "
        f"{views.SPLIT_NAMES[split]} runs, as the mean cost of each, design values → {best.label}: "
        f"{listing(changes, len(changes))}."
    ]


def _repeats_commands(view: views.DatasetView) -> bool:
    commands = [trajectory.command for trajectory in view.dataset.split(view.scored) if trajectory.command is not None]
    return len(set(commands)) < len(commands)


def _remarks(view: views.DatasetView, best: EntryStatistics | None) -> blocks.Callout:
    items: list[str] = []
    doubts: list[str] = []
    split = view.scored
    if split == "train":
        items.append("No runs are held out: costs and errors are those of the data that were fitted.")
    if best is not None:
        doubts = _doubts(view, best) + _worse_commands(view, best)
        items += doubts
        worse = _apart(view, 1)
        if worse:
            items.append(
                f"Worse than {best.label} by more than the noise, as the mean difference in {views.SPLIT_NAMES[split]} "
                f"cost with its 95 % interval: {listing(worse)}."
            )
    for entry in view.statistics:
        bad = [run.record for run in view.runs if run.record.label == entry.label and run.matrix is None]
        if bad:
            reasons = listing(list(dict.fromkeys(f"{record.outcome}: {record.reason}" for record in bad)), 2)
            items.append(f"{entry.label} gave no answer in {len(bad)} of {plural(entry.runs, 'run')} ({reasons}).")
    bound = [entry.label for entry, run in view.calibrated if views.on_bounds(run.record)]
    if bound:
        items.append(f"Held back by the box, with elements on a bound: {listing(bound)}. A wider box may do better.")
    if view.units[split].name == "run" and _repeats_commands(view):
        items.append(
            "The intervals are over runs like these. Runs of one command share what the model misses there, so for "
            "commands that were not driven here the spread is larger (bootstrap: {unit: command})."
        )
    failed = any(entry.answers < entry.runs for entry in view.statistics)
    return blocks.Callout("To be kept in mind", tuple(items), "warning" if doubts or failed else "plain")
