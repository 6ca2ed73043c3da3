"""Results of a comparison and of a study on a terminal: the tables of their reports."""

from __future__ import annotations

from functools import partial

from rich.console import Console

from omnibench.cli.terminal.console import print_ending
from omnibench.compare.output import calibration_file
from omnibench.compare.report.cost_tables import cost_table
from omnibench.compare.report.error_figures import final_error_table
from omnibench.compare.report.outcome_tables import entry_table, run_table
from omnibench.compare.report.view import views
from omnibench.compare.result import ComparisonResult
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.calibration_report import how_to_use
from omnibench.report.numbers import NOTHING, fixed
from omnibench.report.terminal import print_table
from omnibench.robot.calibration import read_calibration
from omnibench.study.report import cell_words
from omnibench.study.study_result import StudyResult, mean_ratio
from omnibench.words import kind_of_data, plural


def print_result(console: Console, result: ComparisonResult) -> None:
    """Print the tables of every data set, and the runs without an answer."""
    for view in views(result):
        kind = kind_of_data(view.dataset.simulated)
        console.print(f"{view.name} ({kind}), cost {result.config.objective}", soft_wrap=True)
        tables = [cost_table(view, split) for split in view.splits]
        tables += [final_error_table(view, split) for split in view.splits]
        for table in (*tables, entry_table(view), run_table(view, typical=True)):
            console.print()
            print_table(console, table)
        console.print()
    for failure in result.failures:
        console.print(f"no answer: {failure}", soft_wrap=True)


def print_comparison_ending(result: ComparisonResult) -> None:
    """Print the last sentence of ``compare``: which entry is best, and how to use or to check its calibration."""
    compared = f"{plural(len({run.record.label for run in result.runs}), 'entry')} compared"
    name, best = next(iter(result.held_out.items()), ("", None))
    file = None if best is None else calibration_file(result, name, best.label)
    if best is None or file is None:
        print_ending(f"{compared} in {result.output}", "read report.html in that folder")
    elif best.verdict.verdict == "better":
        outcome = f"{compared}; the best on {name}, {best.label}, beats the design on runs held out"
        then, command = how_to_use(read_calibration(file), file)
        print_ending(outcome, then, *command)
    else:
        unsure = f"{compared}; that the best on {name}, {best.label}, beats the design was not shown by runs held out"
        print_ending(unsure, f"read {result.output / 'report.html'} and record more runs for validation")


_SHOWN = 10  # failures that are listed; the others are counted (chosen: half a terminal)


def print_study(console: Console, result: StudyResult) -> None:
    """Print the table of cells, the recordings that cannot be read and the fits that failed."""
    console.print()
    print_table(console, _cells(result))
    console.print()
    print_table(console, _methods(result))
    console.print()
    for name, reason in result.broken.items():
        console.print(f"cannot be read: {name}: {reason}", soft_wrap=True)
    for failure in result.failures[:_SHOWN]:
        console.print(f"no answer: {failure}", soft_wrap=True)
    if len(result.failures) > _SHOWN:
        console.print(f"and {len(result.failures) - _SHOWN} more without an answer, see study.parquet", soft_wrap=True)


def print_study_ending(result: StudyResult) -> bool:
    """Print the last sentence of a study; False where a recording cannot be read or no method answered."""
    report = result.output / "report.html"
    if result.nothing_answered:
        first = result.failures[0] if result.failures else "no method is for these robots"
        print_ending(f"no method gave an answer, the first: {first}", "mend what its reason names, and run again")
        return False
    if result.broken:
        ending = f"{plural(len(result.broken), 'robot')} left out, whose recordings cannot be read"
        print_ending(ending, "say where they are with --data, or take them out of the config, and run again")
        return False
    compared = result.against_best
    if not compared or result.geometric_mean is None:
        print_ending(f"{plural(len(result.judged_cells), 'cell')} judged", f"read {report}")
        return True
    worse = sum(each.ratio.verdict == "worse" for each in compared)
    print_ending(
        f"the error of {result.config.reference} is {result.geometric_mean:.2f} times that of the best published "
        f"method of each cell ({plural(len(compared), 'cell')}, worse beyond chance in {worse or 'none'})",
        f"read {report}",
    )
    return True


def _methods(result: StudyResult) -> Table:
    """Every method on every robot: geometric mean over cells of its error as a share of the design's, or why none."""
    robots = [robot.name for robot in result.robots]
    rows = []
    for method in (choice.shown for choice in result.config.methods):
        cells = []
        for robot in robots:
            mine = [c for c in result.judged_cells if c.key.robot == robot and method in c.methods]
            ratios = [ratio.value for c in mine if (ratio := c.against_design(method, 1)) is not None]
            silent = mine[0].methods[method].status if mine else NOTHING
            mean = mean_ratio(ratios)
            cells.append(silent if mean is None else Cell(fixed(mean, 2), plural(len(ratios), "cell")))
        rows.append(Row.of(method, *cells))
    caption = "Error as a share of the design's, geometric mean over cells"
    columns = (Column("Method", numeric=False), *map(Column, robots))
    return Table(caption, columns, tuple(rows), "Every cell and method, with reasons: report.html and study.parquet.")


def _cells(result: StudyResult) -> Table:
    """The least error of each cell beside the design's and the reference method's."""
    ratios = {id(each.cell): each for each in result.against_best}
    reference = result.config.reference
    rows = []
    for cell in result.judged_cells:
        answered = [each for each in cell.methods.values() if each.errors is not None]
        best = min(answered, key=lambda each: each.mean("cost") or 0.0, default=None)
        ours, beside = cell.methods.get(reference or ""), ratios.get(id(cell))
        figures = [fixed(float(cell.design["cost"].mean()), 4)]
        figures.append(NOTHING if best is None else f"{fixed(best.mean('cost'), 4)} {best.method}")
        figures.append(fixed(None if ours is None else ours.mean("cost"), 4))
        figures.append(NOTHING if beside is None else f"{fixed(beside.ratio.value, 2)} {beside.best}")
        verdict = NOTHING if beside is None else beside.ratio.verdict
        rows.append(Row.of(cell.key.robot, cell_words(cell), *figures, verdict))
    text = partial(Column, numeric=False)
    columns = [text("Robot"), text("Training → judged"), Column("Design"), text("Least")]
    columns += [Column(reference or "Reference"), text("Beside the best published"), text("Verdict")]
    return Table("Mean error of runs that did not train, Eq. (6)", tuple(columns), tuple(rows))
