"""The answer of a comparison on one data set: a sentence, the main figures, paths before and after, doubts."""

from __future__ import annotations

import math
from collections.abc import Iterator

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
_ARRIVED = 0.01  # relative: a search whose training cost is further above the lowest one missed the minimum (chosen)
_SEEDS_DIFFER = 0.25  # share of the interval's width: seeds whose costs differ by more are worth a remark (chosen)


def answer_section(view: views.DatasetView) -> blocks.Section:
    """The sentence, tiles, paths before and after, all entries, the verdict of held-out runs, and doubts."""
    more: list[blocks.Block] = []
    if (chart := entry_chart(view)) is not None:
        more.append(chart)
    if view.held_out is not None:
        verdict = view.held_out.verdict
        tone: blocks.Tone = "plain" if verdict.verdict == "better" else "warning"
        words = typeset(f"{view.held_out.label}, {verdict.sentence}")
        more.append(blocks.Callout(words, (typeset(verdict.detail),), tone))
    if sessions := view.result.sessions.get(view.name, ()):
        more.append(blocks.Callout("Sessions", sessions, "warning"))
    doubts, remarks = tuple(_doubts(view)), tuple(_remarks(view))
    failed = any(entry.answers < entry.runs for entry in view.statistics)
    tone = "warning" if doubts or failed else "plain"
    more.append(blocks.Callout("To be kept in mind", (*doubts, *remarks), tone))
    won = view.best is not None and view.best.calibrator != THEORETICAL_NAME
    tiles = tuple(_tiles(view)) if won else ()
    picture = None if view.best is None else path_picture(view)
    return blocks.answer_section(answer_sentence(view), tiles, picture, *more)


def answer_sentence(view: views.DatasetView) -> str:
    """The answer in a sentence or two: what the best calibration gained, and what it is not told apart from."""
    best, split = view.best, view.scored
    labels = [entry.label for entry, _ in view.calibrated]
    if best is None:
        return f"No calibrator gave an answer: {plural(len(view.runs), 'run')}, none usable; the reasons are below."
    if not labels:
        return "Only the design values gave an answer; there is no calibration to compare them with."
    runs = plural(len(view.dataset.split(split)), f"{views.SPLIT_NAMES[split]} run")
    if best.calibrator == THEORETICAL_NAME:
        return f"No calibrator did better than the design values on the {runs}: {listing(labels)}."
    words = f"On the {runs}, {best.label} has the best calibration"
    if changes := list(_changes(view, best)):
        before, after = (" and ".join(change[end] for change in changes) for end in (0, 1))
        words = f"On the {runs}, the odometry calibrated by {best.label} ends {after} from the reference, where the "
        words += f"design values end {before} off"
        if view.without_poses:
            words = f"On the {runs}, {best.label} misses the references by {after}, where the design values miss them "
            words += f"by {before}"
    improvement = best.improvement(split)
    if improvement is not None:
        fell, sure = views.improvement_cells(best, split, 1)
        words += f": the cost fell by {fell}{_with_interval(sure)}"
        chance = improvement.known is not None and improvement.holds(0.0)
        words += ", which the noise alone could explain" if chance else ""
    if len(labels) == 1:
        return f"{words}. {best.label} is the only calibrator with an answer."
    if view.undecided:
        return f"{words}. Which entry is best cannot be said ({view.units(split).ratio_words})."
    if not view.rivals:
        return f"{words}. {best.label} is best."
    rivals = ["the design values" if e.calibrator == THEORETICAL_NAME else e.label for e in view.rivals]
    named = listing(rivals, 3) if len(rivals) <= 3 else f"{len(rivals)} other entries"
    return f"{words}. Not told apart from it: {named}; it has the lowest training cost of these."


def _changes(view: views.DatasetView, best: EntryStatistics) -> Iterator[tuple[str, str, str]]:
    """Mean errors of positions, then of headings, before and after calibration, and the worst one after."""
    after = None if best.typical is None else view.errors(best.typical, view.scored)
    if after is None:
        return
    (p0, h0), (p1, h1) = positions_and_headings(view.design_errors[view.scored]), positions_and_headings(after)
    factor, unit, digits = views.position_unit(views.mean_and_worst(p0)[0], views.mean_and_worst(p1)[0])
    for was, now, scale, decimals, of_scale in ((p0, p1, factor, digits, unit), (h0, h1, math.degrees(1.0), 2, "°")):
        (mean, worst), (before, _) = views.mean_and_worst(now), views.mean_and_worst(was)
        if not math.isnan(mean):
            old, new, most = (with_unit(fixed(scale * each, decimals), of_scale) for each in (before, mean, worst))
            yield old, new, most


def _tiles(view: views.DatasetView) -> Iterator[blocks.Fact]:
    best, split, decimals = view.best, view.scored, view.cost_decimals
    assert best is not None  # there is an answer
    for old, new, worst in _changes(view, best):
        kind = "heading" if worst.endswith("°") else "position"
        name = f"Final {kind} error, mean"
        if view.without_poses:
            name = f"Error of {'angles' if kind == 'heading' else 'lengths and places'}, mean"
        before = old if kind == "heading" else old.rpartition(" ")[0]
        yield blocks.Fact(name, f"{before} → {new}", f"worst {worst}")
    reached = best.cost(split)
    if reached is not None:
        change = f"{fixed(view.theoretical_cost(split), decimals)} → {fixed(reached.value, decimals)}"
        sure = _with_interval(views.interval_cell(reached, decimals)).strip(" ()")
        yield blocks.Fact(f"Cost, {views.SPLIT_NAMES[split]} runs", change, sure)
    if best.improvement(split) is not None:
        fell, sure = views.improvement_cells(best, split, 1)
        yield blocks.Fact("Improvement of the cost", fell, _with_interval(sure).strip(" ()"))


def _with_interval(words: str) -> str:
    return "" if words == views.NO_INTERVAL else f" (95 % interval {words})"


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


def entry_chart(view: views.DatasetView) -> blocks.FigureGrid | None:
    """Every entry's cost on the scored split, the lowest on top; None where no entry was calibrated."""
    lines: list[tuple[str, Interval, blocks.LegendItem]] = []
    for entry, _ in view.calibrated:
        if (cost := entry.cost(view.scored)) is not None:
            best = entry.is_best and not view.undecided
            lines.append((entry.label, cost, _BEST if best else _OTHER if entry.practically_equal is False else _OPEN))
    if not lines:
        return None
    lines.sort(key=lambda each: each[1].value)
    if (design := view.design_costs.get(view.scored)) is not None:
        lines.append(("design values", design, views.THEORETICAL_STYLE))
    decimals, traces, items = view.cost_decimals, list[go.Scatter](), list[blocks.LegendItem]()
    for item in (_BEST, _OTHER, _OPEN, views.THEORETICAL_STYLE):
        mine = [(row, label, cost) for row, (label, cost, of_line) in enumerate(lines) if of_line is item]
        spans = [np.column_stack([cost.known, [row, row]]) for row, _, cost in mine if cost.known is not None]
        words = [f"{label}: {fixed(c.value, decimals)} ({views.interval_cell(c, decimals)})" for _, label, c in mine]
        traces += [line(item, 2.5, *joined(spans).T, line_dash="solid")] if spans else []
        values, places = [cost.value for _, _, cost in mine], [float(row) for row, _, _ in mine]
        traces += [marks(item, 10, values, places, hover="%{text}", words=words)] if mine else []
        items += [item] if mine else []
    split = views.SPLIT_NAMES[view.scored]
    figure = plot(*traces, x_title=f"cost of the {split} runs")
    figure.update_xaxes(range=[0.0, 1.04 * max(max(cost.known or (cost.value,)) for _, cost, _ in lines)])
    names = [text(wrapped(label)) for label, _, _ in lines]
    height = 70 + (_ROW + _LINE * max(1 + name.count("<br>") for name in names)) * len(lines)
    ends = {"range": [len(lines) - 0.4, -0.6], "tickvals": list(range(len(lines))), "ticktext": names}
    figure.update_yaxes(**ends, ticks="", tickfont_color=INK, showgrid=False)
    described = ", ".join(f"{label} {fixed(cost.value, decimals)}" for label, cost, _ in lines)
    title = f"All entries: cost of the {split} runs, with 95 % intervals"
    caption = (
        f"The lower, the better. Intervals: {view.units(view.scored).ratio_words}; whether entries differ is judged "
        "from paired differences, which is finer."
    )
    picture = blocks.Figure(title, figure, f"{title}: {described}", height)
    return blocks.FigureGrid((picture,), tuple(items), 1, caption, "all-entries")


def _doubts(view: views.DatasetView) -> Iterator[str]:
    """Reasons to doubt the first place: seeds that differ, a minimum that was missed, commands that became worse."""
    best, split, decimals = view.best, view.scored, view.cost_decimals
    if best is None or best.typical is None or best.calibrator == THEORETICAL_NAME:
        return
    values = [run.scores[split].cost for run in view.runs if run.record.label == best.label and split in run.scores]
    reached = best.cost(split)
    low, high = (None if reached is None else reached.known) or (0.0, 0.0)
    if len(values) > 1 and max(values) - min(values) > _SEEDS_DIFFER * (high - low):
        yield (
            f"{best.label} depends on its seed: over {len(values)} seeds its {views.SPLIT_NAMES[split]} cost goes from "
            f"{span(min(values), max(values), decimals)}. The verdict is about the run of median training cost."
        )
    lowest = min((entry.train_median for entry in view.statistics if entry.train_median is not None), default=None)
    if best.train_median is not None and lowest is not None and best.train_median > (1 + _ARRIVED) * lowest + NO_ERROR:
        above = f"{percent(best.train_median / lowest - 1)} above the lowest"
        if lowest <= NO_ERROR:
            above = f"{significant(best.train_median, 2)}, where the lowest leaves no error"
        yield (
            f"{best.label} has not found the minimum: its training cost is {above}. That it does better on other data "
            "may be chance, or the splits differ in more than noise."
        )
    # Entries whose held-out cost is lower by more than the noise, though their training cost is higher
    lower = [
        "{}: {} ({})".format(entry.label, *views.difference_cells(entry.difference))
        for entry, _ in view.calibrated
        if entry.difference is not None and entry.practically_equal is False and entry.difference.value < 0
    ]
    if lower:
        yield (
            f"Below {best.label} in {views.SPLIT_NAMES[split]} cost, as the mean difference with its 95 % interval, "
            f"though above it in training cost: {listing(lower, 20)}."
        )
    # Commands on which it does worse than the design values
    before, after = best.typical.design[split].costs, best.typical.scores[split].costs
    rows: dict[str, list[int]] = {}
    for index, run in enumerate(view.dataset.split(split)):
        if run.command is not None:
            rows.setdefault(run.command, []).append(index)
    means = [(name, float(before[chosen].mean()), float(after[chosen].mean())) for name, chosen in rows.items()]
    worse = sorted((row for row in means if row[2] > row[1]), key=lambda row: row[1] - row[2])
    if worse:
        changes = [f"{name} {fixed(was, decimals)} → {fixed(now, decimals)}" for name, was, now in worse]
        yield (
            f"{best.label} does worse than the design values on {len(worse)} of {plural(len(means), 'command')} of the "
            f"{views.SPLIT_NAMES[split]} runs: {listing(changes, len(changes))}."
        )


def _remarks(view: views.DatasetView) -> Iterator[str]:
    split = view.scored
    if split == "train":
        yield "No runs are held out: costs and errors are those of the data that were fitted."
    for entry in view.statistics:
        bad = [run.record for run in view.runs if run.record.label == entry.label and run.matrix is None]
        if bad:
            reasons = listing(list(dict.fromkeys(f"{record.outcome}: {record.reason}" for record in bad)), 2)
            yield f"{entry.label} gave no answer in {len(bad)} of {plural(entry.runs, 'run')} ({reasons})."
    bound = [entry.label for entry, run in view.calibrated if set(run.record.at_bounds) - set(run.record.held)]
    if bound:
        yield f"Held back by the box, with elements on a bound: {listing(bound)}. A wider box may do better."
    commands = [run.command for run in view.dataset.split(split) if run.command is not None]
    if view.units(split).name == "run" and len(set(commands)) < len(commands):
        yield (
            "The intervals are over runs like these. Runs of one command share what the model misses there, so for "
            "commands that were not driven here the spread is larger (bootstrap: {unit: command})."
        )
