"""Tables on a terminal: whole in any width, and what is left out is named; comparisons, calibrations and progress."""

import os
import pty
import re
import subprocess
from contextlib import suppress
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import COMMAND, ENVIRONMENT, Command, compared_here, rows, search, succeeded, write_config
from report_page import Page, on_terminal
from rich.console import Console
from sample_robots import APR_02, DIFFERENTIAL, SWERVE, TRICYCLE
from syrupy.assertion import SnapshotAssertion
from timing import PATIENCE
from wheeled_recordings import PERIOD as RECORDED
from wheeled_recordings import recorded
from wheeled_samples import driven

from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.compare.report.comparison_view import ComparisonView
from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.fit.calibrate import calibrate
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.problem import Budget
from omnibench.progress import Progress, Stages
from omnibench.report.blocks import Cell, Column, Document, Row, Section, Table
from omnibench.report.calibration_report import CalibrationResult
from omnibench.report.recording.inspection_report import InspectionResult
from omnibench.report.render import render
from omnibench.report.result import Result
from omnibench.report.terminal import print_result, print_table
from omnibench.robot.calibration import HeldOutVerdict
from omnibench.robot.kinematics import Robot, Wheel
from omnibench.testing.synthetic import PERIOD, synthetic_trajectories

TABLE = Table(
    "Costs [red]",
    (
        Column("Entry", numeric=False),
        Column("CF theoretical"),
        Column("CF training"),
        Column("Improvement", priority=1),
        Column("Gap above exact optimum", "relative", priority=2),
    ),
    (
        Row.of("theoretical", Cell("0.1387", "0.1301 to 0.1465"), "–", "–", "5.58 s"),
        Row.of(Cell("closed_form", "matrix, box paper"), "0.1387", Cell("0.0387", "0.0301 to 0.0465"), "72.11 %", "0"),
        Row.of("Published elsewhere: not comparable row by row", role="group"),
        Row.of("crs", "0.1387", "0.0387", "72.11 %", Cell("9.3 × 10⁻⁹", "proven: ≤ 0.58 %"), role="muted"),
    ),
    "As Table 2 of the paper.",
)


def printed(table: Table, width: int) -> str:
    return on_terminal(print_table, table, width=width)


@pytest.mark.parametrize("width", [48, 60, 80, 160])
def test_numbers_stay_whole_and_what_is_left_out_is_named(width: int, snapshot: SnapshotAssertion) -> None:
    text = printed(TABLE, width)
    assert text == snapshot
    assert max(map(len, text.splitlines())) <= width
    if "left out" in text:
        match = re.search(r"(\d+) columns show all", " ".join(text.split()))
        assert match
        needed = int(match[1])
        assert "left out" not in printed(TABLE, needed)
        assert "left out" in printed(TABLE, needed - 1)


def test_a_path_may_be_broken_where_it_is_longer_than_a_column_can_be() -> None:
    path = "/home/somebody/robots/plugins/differential_evolution_of_mine.py"
    table = Table("", (Column("name", numeric=False), Column("from", numeric=False)), (Row.of("de", path),))
    assert "".join(printed(table, 40).split()).endswith(f"de{path}")


def test_one_description_gives_the_cells_of_the_report_and_of_the_terminal() -> None:
    page = Page(render(Document("Report", "", (Section("costs", "Costs", (TABLE,)),))))
    shown = [[" ".join(cell.split()) for cell in row] for row in page.tables[TABLE.caption]]
    below_heading = printed(TABLE, 240).split("─\n")[1].splitlines()[:-1]
    assert shown[0] == [column.title + f" ({column.unit})" * bool(column.unit) for column in TABLE.columns]
    assert [re.sub(r" \| (.+)", r" (\1)", cell) for row in shown[1:] for cell in row] == [
        cell for line in below_heading for cell in re.split(r" {2,}", line.strip())
    ]


def test_lesser_columns_are_left_out_before_text_is_squeezed_to_a_word_a_line() -> None:
    columns = (Column("Entry", numeric=False), Column("Outcome", numeric=False), Column("Time", priority=1))
    table = Table(
        "", columns, (Row.of("closed_form_of_mine", "step below the tolerance after four programs", "243 ms"),)
    )
    text = printed(table, 40)
    assert "step below the" in text
    assert "left out for want of room: Time; 45 columns show all" in " ".join(text.split())


# Texts that Rich would take for markup or an emoji.
ODD = "a [/b] [red]b :smile:"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> ComparisonResult:
    entries = ["theoretical", "closed_form", search(), search(ODD, 10), {"name": "closed_form", "label": "again"}]
    refused = {"name": "closed_form", "label": "refused", "parameterisation": "geometry"}
    return compared_here(tmp_path_factory.mktemp("tables") / "out", calibrators=[*entries, refused])


def compared_text(result: ComparisonResult, width: int) -> str:
    return on_terminal(print_result, ComparisonView(result, everything=True), width=width)


def test_all_entries_are_in_every_table_in_usual_units(result: ComparisonResult, snapshot: SnapshotAssertion) -> None:
    # Times, evaluations until convergence, and digits of rounding differ between machines.
    text = re.sub(r"(< )?[\d.,]+ (ms|s|× 10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", "...", compared_text(result, 240))
    text = re.sub(r"\d+ \((< )?\.\.\.\)", "n (...)", text).replace(f"{result.output}/", "")
    assert re.sub(r" {2,}", "  ", re.sub("─+", "─", text)) == snapshot


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_narrow_terminal_wraps_words_and_cuts_no_number(result: ComparisonResult, width: int) -> None:
    tables = compared_text(result, width).split("no answer: ")[0]
    assert "…" not in tables
    assert max(map(len, tables.splitlines())) <= width
    for cell in ("closed_form", "theoretical", "refused", "0.1387"):
        assert cell in tables


def test_forty_four_columns_keep_the_cost_and_the_verdict(result: ComparisonResult) -> None:
    text = on_terminal(print_result, ComparisonView(result), width=44)
    heading = text[text.index("Entry") :].split("─")[0]
    assert heading.split() == ["Entry", "Cost", "best"]
    left_out = "left out for want of room: 95 % interval, Improved, Position (mm), Heading (°);"
    assert left_out in " ".join(text.split())


def test_a_pipe_gets_one_plain_line_for_each_run_and_the_tables(command: Command, tmp_path: Path) -> None:
    run = succeeded(command("compare", write_config(tmp_path, workers=1), "--output", tmp_path / "out"))
    # On a busy machine also how far the simulation or a run is.
    lines = [line for line in run.stderr.splitlines() if " of 2,000" not in line and not line.startswith("simulating")]
    assert [line.split(":")[0] for line in lines] == [
        "comparing",
        "[1/3] flower theoretical seed 1",
        "[2/3] flower closed_form seed 1",
        "[3/3] flower search seed 1",
        "3 entries compared; the best on flower, closed_form, beats the design on runs held out; "
        "next, use it on the robot",
        f"  omnibench export {tmp_path / 'out' / 'calibrations' / 'flower-closed_form.yaml'} --to ros2_controllers",
    ]
    assert "\x1b" not in run.stdout + run.stderr
    assert run.stdout.splitlines()[-1] == f"report: {tmp_path / 'out' / 'report.html'}"
    cost = rows(tmp_path / "out")["closed_form"]["validation_cost"]
    assert re.search(rf"closed_form +{cost:.5f} ", run.stdout)


def on_a_terminal(*arguments: object) -> tuple[int, str]:
    """Exit code and everything shown by a command on a terminal of 80 columns."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        env=ENVIRONMENT | {"TERM": "xterm", "COLUMNS": "80", "LINES": "50"},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    shown = b""
    with suppress(OSError):  # the terminal's other end is closed
        while chunk := os.read(ours, 65536):
            shown += chunk
    os.close(ours)
    return process.wait(timeout=PATIENCE), shown.decode()


def test_a_terminal_shows_a_bar_for_all_runs_and_one_for_each_that_is_under_way(tmp_path: Path) -> None:
    twins = [search(label, 10_000, batch=10) for label in ("[/b] one", "two")]  # the same work under two names
    config = write_config(tmp_path, calibrators=["theoretical", *twins], budget={"evaluations": 10_000})
    code, shown = on_a_terminal("compare", config, "--output", tmp_path / "out")
    assert code == 0, shown
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    assert re.search(r"comparing +━+.* 1 of 3", plain)
    assert re.search(r"flower \[/b\] one seed 1 ━+.*[\d,]+ of 10,000, best 0\.\d{6} 0:", plain)
    assert "flower two seed 1: budget, cost 0." in plain
    assert "Traceback" not in plain


def calibration_lines(dataset: Dataset, *arguments: Any, **options: Any) -> list[str]:
    """What is printed of a data set and its calibration."""
    results: tuple[Result, ...] = (
        CalibrationResult(calibrate(dataset, *arguments, **options)),
        InspectionResult(inspect_dataset(dataset)),
    )
    return "".join(on_terminal(print_result, each, width=160) for each in results).splitlines()


def test_a_matrix_has_an_element_for_each_row_and_drive_signal() -> None:
    elements = CalibrationResult(calibrate(driven(TRICYCLE))).elements().rows
    assert [row.cells[0].text for row in elements[:3]] == ["x: front_cos", "x: front_sin", "y: front_cos"]
    lines = calibration_lines(driven(TRICYCLE))
    assert any(line.startswith("directions of drive signals driven: 2 of 2") for line in lines)
    assert not any("wheel front" in line for line in lines)


@pytest.mark.parametrize("robot", [APR_02, TRICYCLE, SWERVE], ids=lambda robot: robot.name)
def test_a_calibration_shows_physical_parameters_then_the_matrix_on_a_screen_of_80_columns(robot: Robot) -> None:
    runs = recorded(robot, robot.inverse_kinematic_matrix, np.random.default_rng(5))
    run = calibrate(make_dataset(robot.name, robot, RECORDED, runs), mount="fit")
    result = CalibrationResult(run, file=Path("c.yaml"))
    lines = on_terminal(print_result, result, width=80).splitlines()
    assert len(lines) <= 25 - 3 - 2 * len(run.warnings)  # the sentence with the command, and the warnings
    names = [each.name for each in run.parameters]
    assert [line.split()[0] for line in lines if line.split()[0] in names] == names
    first = next(number for number, line in enumerate(lines) if line.startswith("matrix"))
    assert first > max(number for number, line in enumerate(lines) if line.split()[0] in names)
    shown = " ".join(" ".join(lines[first:]).split())
    elements = [f"{value:+.7f}" for value in run.calibration.matrix_array.ravel()]
    assert all(each in shown for each in elements) or re.match(r"matrix \(3 x \d\): not on this screen", lines[first])


def test_a_parameter_has_its_design_value_change_and_interval_in_its_row() -> None:
    runs = recorded(DIFFERENTIAL, 1.02 * DIFFERENTIAL.inverse_kinematic_matrix, np.random.default_rng(5))
    run = calibrate(make_dataset("diff", DIFFERENTIAL, RECORDED, runs))
    row = next(
        line
        for line in on_terminal(print_result, CalibrationResult(run)).splitlines()
        if line.startswith("radius_left")
    )
    (radius,) = (each for each in run.parameters if each.name == "radius_left")
    interval = f"{radius.low:.5f} to {radius.high:.5f}"
    assert (
        " ".join(row.split())
        == f"radius_left 0.05000 {radius.value:.5f} m {radius.deviation_percent:+.2f} % {interval}"
    )


def test_an_element_that_is_0_but_for_rounding_has_no_share_of_the_design() -> None:
    wheels = (Wheel(name=f"{n}", radius=0.05, distance=0.2, angle=n * 2 * np.pi / 3) for n in range(3))
    robot = Robot(name="omni", wheels=tuple(wheels))
    assert 0 < abs(robot.inverse_kinematic_matrix[0, 0]) < 1e-15
    dataset = make_dataset("omni", robot, PERIOD, synthetic_trajectories(robot))
    run = calibrate(dataset, "random_search", budget=Budget(evaluations=200))
    shares = [row.cells[4].text for row in CalibrationResult(run).elements().rows]
    assert shares.count("design 0") == 1
    assert all(abs(float(share.removesuffix(" %"))) < 100 for share in shares if share != "design 0")


def test_without_a_reading_each_element_has_a_row_with_its_interval() -> None:
    runs = recorded(DIFFERENTIAL, DIFFERENTIAL.inverse_kinematic_matrix, np.random.default_rng(5))
    run = calibrate(make_dataset("diff", DIFFERENTIAL, RECORDED, runs))
    bare = run.calibration.model_copy(update={"parameters": {}})
    lines = on_terminal(print_result, CalibrationResult(replace(run, calibration=bare))).splitlines()
    low, high = (run.to_frame()[end][0] for end in ("low", "high"))
    assert f"{low:+.7f} to {high:+.7f}" in lines[2]


@pytest.mark.parametrize(("terminal", "colour"), [(True, "\x1b[1;32mheld out"), (False, "held out")])
def test_a_verdict_has_its_colour_on_a_terminal_and_none_in_a_pipe(terminal: bool, colour: str) -> None:
    runs = recorded(DIFFERENTIAL, 1.02 * DIFFERENTIAL.inverse_kinematic_matrix, np.random.default_rng(5))
    run = calibrate(make_dataset("diff", DIFFERENTIAL, RECORDED, runs))
    better = HeldOutVerdict(verdict="better", sentence="held out: better than the design", detail="")
    console = Console(file=StringIO(), force_terminal=terminal, color_system="standard" if terminal else None)
    print_result(console, CalibrationResult(run, verdict=better, file=Path("c.yaml")))
    assert f"\n{colour}" in console.file.getvalue()


ALWAYS, NEVER = 0.0, 1e9  # s between two lines of a task that goes on


def progress_text(*events: Progress, period: float = NEVER, terminal: bool = False, width: int = 80) -> str:
    """Everything that is written while the events come."""
    text = StringIO()
    console = Console(file=text, width=width, force_terminal=terminal, color_system=None, highlight=False)
    with ProgressDisplay(console, period) as display:
        for event in events:
            display(event)
    return text.getvalue()


@pytest.mark.parametrize("width", [60, 80, 160])
def test_a_terminal_shows_all_tasks_at_once_and_cuts_nothing(width: int) -> None:
    tasks = [
        Progress("comparing", 3, 36, "run"),
        Progress("apr02 closed_form seed 1", 1200, 60000, "evaluation", best=0.138732),
    ]
    words = progress_text(*tasks, terminal=True, width=width)
    assert "…" not in words
    told = " ".join(words.split())
    for word in ("comparing", "3 of 36", "0:00:00", "seed", "60,000", "0.138732"):
        assert word in told


def stages() -> list[Progress]:
    events: list[Progress] = []
    stages = Stages(events.append)
    stages.begin("fitting the plain matrix")
    stages.begin("looking where it fails")
    stages.end()
    return events


SEARCH = [
    Progress("search", 100, 2000, "evaluation", best=float("inf")),
    Progress("search", 1200, 2000, "evaluation", best=0.25, note="still falling"),
]
WITHIN_A_TASK = [
    Progress("comparing", 0, 2, "run"),
    Progress("one", 0, 50),
    Progress("two", 0, 50),
    Progress("two", 7, 50, result="[1/2] two: failed"),
    Progress("one", 50, 50, result="[2/2] one: done [at last]"),
    Progress("comparing", 2, 2, "run"),
]


@pytest.mark.parametrize(
    ("events", "period", "lines"),
    [
        ([Progress("SLAM", done, 3, "run") for done in range(4)], NEVER, "SLAM: 3 runs\n"),
        (stages(), NEVER, "fitting the plain matrix\nlooking where it fails\n"),
        (SEARCH, NEVER, ""),
        (SEARCH, ALWAYS, "search: 100 of 2,000\nsearch: 1,200 of 2,000, best 0.250000, still falling\n"),
        (WITHIN_A_TASK, NEVER, "comparing: 2 runs\n[1/2] two: failed\n[2/2] one: done [at last]\n"),
    ],
    ids=["a task", "stages", "within a period", "after each period", "within a task"],
)
def test_a_pipe_gets_lines(events: list[Progress], period: float, lines: str) -> None:
    assert progress_text(*events, period=period) == lines


def test_a_terminal_keeps_the_results_and_forgets_the_bars() -> None:
    text = progress_text(Progress("one", 0, 50), Progress("one", 7, 50, result="one: failed"), terminal=True)
    assert "one: failed\n" in text
    assert "of 50" not in text.split("one: failed")[1]
