"""The answer of a comparison: a sentence, the main figures, the paths before and after or all ratios, and doubts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

from omnibench.compare.config import THEORETICAL_NAME
from omnibench.compare.report import view as views
from omnibench.compare.report.charts import interval_chart
from omnibench.compare.report.tables import methods_table
from omnibench.compare.result import ComparisonResult, EntryStatistics
from omnibench.fit.cost import NO_ERROR
from omnibench.fit.evaluate import positions_and_headings
from omnibench.fit.noise import grouped
from omnibench.report import blocks
from omnibench.report.numbers import fixed, listing, percent, significant, span, typeset, with_unit
from omnibench.report.path_pictures import CALIBRATED, paths_before_after
from omnibench.report.style import INK, PALETTE, QUIET, logarithmic
from omnibench.words import plural

_BEST = blocks.LegendItem("best", "best", PALETTE[0])
_OTHER = blocks.LegendItem("other", "differs by more than chance", PALETTE[1])
_OPEN = blocks.LegendItem("open", "not told apart", QUIET)
_VERDICTS = {
    "better": blocks.LegendItem("better", "less error than the best published method", PALETTE[0]),
    "undecided": blocks.LegendItem("undecided", "chance could explain the difference", QUIET),
    "worse": blocks.LegendItem("worse", "more error", "#c8102e"),
}
_ARRIVED = 0.01  # relative: a search whose training cost is further above the lowest one missed the minimum (chosen)
_SEEDS_DIFFER = 0.25  # share of the interval's width: seeds whose costs differ by more are worth a remark (chosen)


def answer_section(view: views.DatasetView) -> blocks.Section:
    """The sentence, tiles, paths before and after, all entries, the verdict of held-out runs, and doubts."""
    more: list[blocks.Block] = []
    if (chart := entry_chart(view)) is not None:
        more.append(chart)
    if (held_out := view.result.held_out.get(view.name)) is not None:
        tone: blocks.Tone = "plain" if held_out.verdict.verdict == "better" else "warning"
        words = typeset(f"{held_out.label}, {held_out.verdict.sentence}")
        more.append(blocks.Callout(words, (typeset(held_out.verdict.detail),), tone))
    if sessions := view.result.sessions.get(view.name, ()):
        more.append(blocks.Callout("Sessions", sessions, "warning"))
    doubts, remarks = tuple(_doubts(view)), tuple(_remarks(view))
    failed = any(entry.answers < entry.runs for entry in view.statistics)
    more.append(blocks.Callout("To be kept in mind", (*doubts, *remarks), "warning" if doubts or failed else "plain"))
    picture = None if view.best is None else path_picture(view)
    return blocks.answer_section(answer_sentence(view), tuple(_tiles(view)), picture, *more)


def answer_sentence(view: views.DatasetView) -> str:
    """What the best calibration gained, and what it is not told apart from."""
    best, labels = view.best, [entry.label for entry, _ in view.calibrated]
    if best is None:
        return f"No calibrator gave an answer: {plural(len(view.runs), 'run')}, none usable; the reasons are below."
    if not labels:
        return "Only the design values gave an answer; there is no calibration to compare them with."
    runs = view.runs_in_words(view.scored)
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
    if (improvement := best.improvement(view.scored)) is not None:
        fell, sure = views.improvement_cells(improvement, 1)
        words += f": the cost fell by {fell}{'' if improvement.known is None else f' (95 % interval {sure})'}"
        words += ", which the noise alone could explain" if improvement.known and improvement.holds(0.0) else ""
    if len(labels) == 1:
        return f"{words}. {best.label} is the only calibrator with an answer."
    if view.undecided:
        return f"{words}. Which entry is best cannot be said ({view.units(view.scored).ratio_words})."
    rivals = ["the design values" if e.calibrator == THEORETICAL_NAME else e.label for e in view.rivals]
    if not rivals:
        return f"{words}. {best.label} is best."
    named = listing(rivals) if len(rivals) <= 3 else f"{len(rivals)} other entries"
    return f"{words}. Not told apart from it: {named}; it has the lowest training cost of these."


def _changes(view: views.DatasetView, best: EntryStatistics) -> Iterator[tuple[str, str, str]]:
    """Mean errors of positions, then of headings, before and after calibration, and the worst one after."""
    after = view.errors(best, view.scored)
    if after is None:
        return
    (p0, h0), (p1, h1) = positions_and_headings(view.design_errors[view.scored]), positions_and_headings(after)
    factor, unit, digits = views.position_unit(views.mean_and_worst(p0)[0], views.mean_and_worst(p1)[0])
    for was, now, scale, decimals, of_scale in ((p0, p1, factor, digits, unit), (h0, h1, math.degrees(1.0), 2, "°")):
        numbers = (views.mean_and_worst(was)[0], *views.mean_and_worst(now))
        if not math.isnan(numbers[1]):
            old, new, worst = (with_unit(fixed(scale * each, decimals), of_scale) for each in numbers)
            yield old, new, worst


def _tiles(view: views.DatasetView) -> Iterator[blocks.Fact]:
    best, split, decimals = view.best, view.scored, view.cost_decimals
    if best is None or best.calibrator == THEORETICAL_NAME:
        return
    for old, new, worst in _changes(view, best):
        kind, parts = ("heading", "angles") if worst.endswith("°") else ("position", "lengths and places")
        name = f"Error of {parts}, mean" if view.without_poses else f"Final {kind} error, mean"
        yield blocks.Fact(name, f"{old if kind == 'heading' else old.rpartition(' ')[0]} → {new}", f"worst {worst}")
    cost, improvement = best.costs[split], best.improvements[split]
    before = fixed(view.design_costs[split].value, decimals)
    sure = f"95 % interval {views.interval_cell(cost, decimals)}" if cost.known else ""
    yield blocks.Fact(f"Cost, {views.SPLIT_NAMES[split]} runs", f"{before} → {fixed(cost.value, decimals)}", sure)
    if improvement is not None:
        fell, sure = views.improvement_cells(improvement, 1)
        yield blocks.Fact("Improvement of the cost", fell, f"95 % interval {sure}" if improvement.known else "")


def path_picture(view: views.DatasetView) -> blocks.FigureGrid | None:
    """Paths of a few runs of the scored split: reference, design values and the best calibration."""
    models, best = [(views.THEORETICAL_STYLE, view.model())], view.best
    if best is not None and best.calibrator != THEORETICAL_NAME and best.typical is not None:
        style = blocks.LegendItem("calibrated", f"calibrated by {best.label}", CALIBRATED)
        models.append((style, view.model(best.typical.matrix, best.typical.result.extension)))
    return paths_before_after(view.dataset.split(view.scored), models, views.SPLIT_NAMES[view.scored])


def entry_chart(view: views.DatasetView) -> blocks.FigureGrid | None:
    """Every entry's cost on the scored split, the lowest on top; None where no entry was calibrated."""
    known = [(entry, entry.costs[view.scored]) for entry, _ in view.calibrated if view.scored in entry.costs]
    if not known:
        return None
    shown = []
    for entry, cost in sorted(known, key=lambda each: each[1].value):
        best = entry.is_best and not view.undecided
        item = _BEST if best else _OTHER if entry.practically_equal is False else _OPEN
        shown.append((entry.label, cost, item))
    if (design := view.design_costs.get(view.scored)) is not None:
        shown.append(("design values", design, views.THEORETICAL_STYLE))
    digits, split = view.cost_decimals, views.SPLIT_NAMES[view.scored]
    lines = [
        (label, cost, item, f"{label}: {fixed(cost.value, digits)} ({views.interval_cell(cost, digits)})")
        for label, cost, item in shown
    ]
    title = f"All entries: cost of the {split} runs, with 95 % intervals"
    caption = (
        f"The lower, the better. Intervals: {view.units(view.scored).ratio_words}; whether entries differ is judged "
        "from paired differences, which is finer."
    )
    chart = interval_chart(lines, title, f"cost of the {split} runs", caption, "all-entries")
    most = max(max(cost.known or (cost.value,)) for _, cost, _ in shown)
    chart.figures[0].plot.update_xaxes(range=[0.0, 1.04 * most])
    return chart


def _doubts(view: views.DatasetView) -> Iterator[str]:
    """Reasons to doubt the first place: seeds that differ, a minimum that was missed, commands that became worse."""
    best, split, decimals = view.best, view.scored, view.cost_decimals
    if best is None or best.typical is None or best.calibrator == THEORETICAL_NAME:
        return
    values = [run.scores[split].cost for run in view.runs if run.record.label == best.label and split in run.scores]
    low, high = best.costs[split].known or (0.0, 0.0)
    if len(values) > 1 and max(values) - min(values) > _SEEDS_DIFFER * (high - low):
        yield (
            f"{best.label} depends on its seed: over {len(values)} seeds its {views.SPLIT_NAMES[split]} cost goes from "
            f"{span(min(values), max(values), decimals)}. The verdict is about the run of median training cost."
        )
    lowest = min(entry.train_median for entry in view.statistics if entry.train_median is not None)
    if best.train_median is not None and best.train_median > (1 + _ARRIVED) * lowest + NO_ERROR:
        above = f"{percent(best.train_median / lowest - 1)} above the lowest"
        if lowest <= NO_ERROR:
            above = f"{significant(best.train_median, 2)}, where the lowest leaves no error"
        yield (
            f"{best.label} has not found the minimum: its training cost is {above}. That it does better on other data "
            "may be chance, or the splits differ in more than noise."
        )
    # Commands on which it does worse than the design values
    before, after = best.typical.design[split].costs, best.typical.scores[split].costs
    commands = [run.command for run in view.dataset.split(split)]
    rows = {name: list(alike) for alike in grouped(commands) if (name := commands[alike[0]]) is not None}
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


def robots_sentence(result: ComparisonResult) -> str:
    """The answer on several robots in a sentence."""
    worse = sum(each.ratio.verdict == "worse" for each in result.against_best)
    if result.geometric_mean is None:
        cells, robots = plural(len(result.judged_cells), "cell"), plural(len(result.robots), "robot")
        return f"{plural(len(result.config.entries), 'method')} judged in {cells} of {robots}, by runs not seen before."
    return (
        f"The error of {result.config.reference} is {fixed(result.geometric_mean, 2)} times that of the best published "
        f"method of each cell (geometric mean of {plural(len(result.against_best), 'cell')}); it is worse beyond "
        f"chance in {worse or 'none'}."
    )


def robots_answer(result: ComparisonResult) -> blocks.Section:
    """The sentence, tiles, and the reference method beside the best published one in every cell."""
    asked = sum(not run.fit.refusal for run in result.runs)
    size = f"{plural(len(result.config.entries), 'method')}, {plural(len(result.robots), 'robot')}"
    tiles = [blocks.Fact("Size", size, f"{plural(len(result.judged_cells), 'cell')}, {plural(asked, 'fit')}")]
    if (chart := ratio_chart(result)) is not None:
        mean, verdicts = fixed(result.geometric_mean, 2), Counter(each.ratio.verdict for each in result.against_best)
        tiles.append(blocks.Fact("Ratio of errors, geometric mean", mean, "below 1: less error"))
        counts = ", ".join(str(verdicts[name]) for name in ("better", "undecided", "worse"))
        tiles.append(blocks.Fact("Better, undecided, worse", counts, "cells, family-wise"))
    return blocks.answer_section(robots_sentence(result), tiles, chart, methods_table(result))


def ratio_chart(result: ComparisonResult) -> blocks.FigureGrid | None:
    """The reference method's error as a ratio to the best published one's, cell by cell; None without such cells."""
    lines = []
    for each in result.against_best:
        label = f"{each.cell.key.robot}: {each.cell.key.within_robot}"
        words = (
            f"{label}: {result.config.reference} {fixed(each.ratio.value, 2)} x {each.best} "
            f"({views.interval_cell(each.ratio.in_family, 2)}, {each.ratio.units})"
        )
        lines.append((f"{label}  [{each.best}]", each.ratio.in_family, _VERDICTS[each.ratio.verdict], words))
    if not lines:
        return None
    caption = (
        f"Ratio of {result.config.reference}'s mean error to that of the published method of least error in the cell, "
        "in brackets, which is chosen after the fact: the comparison favours it. Intervals hold for all cells together."
    )
    title = "Beside the best published method, cell by cell"
    chart = interval_chart(lines, title, "ratio of errors", caption, "against-the-best-published")
    ratios, figure = [each.ratio.value for each in result.against_best], chart.figures[0].plot
    logarithmic(figure, "x", max(min([*ratios, 0.5]) / 2, 0.05), min(max([*ratios, 2.0]) * 2, 20.0))
    figure.add_vline(x=1.0, line_color=INK, line_width=1)
    return chart
