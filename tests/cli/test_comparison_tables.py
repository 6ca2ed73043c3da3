"""What a comparison shows on a terminal: bars while it runs, the paper's tables at its end, in any width."""

from __future__ import annotations

import io
import math
import os
import pty
import re
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from commands import COMMAND, ENVIRONMENT, compared, compared_here, flower, search, summary, write_config
from rich.console import Console
from timing import PATIENCE

from omnibench.cli.terminal.comparison_tables import print_result
from omnibench.compare.result import ComparisonResult

# Texts that Rich would take for markup or an emoji.
ODD = "a [/b] [red]b :smile:"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> ComparisonResult:
    entries = ["theoretical", "closed_form", search(), search(ODD, 10), {"name": "closed_form", "label": "again"}]
    refused = {"name": "closed_form", "label": "refused", "parameterisation": "geometry"}
    return compared_here(tmp_path_factory.mktemp("tables") / "out", calibrators=[*entries, refused])


def printed(result: ComparisonResult, width: int = 160) -> str:
    stream = io.StringIO()
    print_result(Console(file=stream, width=width, markup=False, emoji=False, highlight=False), result)
    return stream.getvalue()


def table(text: str, title: str) -> dict[str, list[str]]:
    """Cells of a printed table by its first column, whose notes in brackets are left out."""
    lines = text.split(title, 1)[1].split("───\n", 1)[1].split("\n\n", 1)[0].splitlines()
    cells = [re.split(r"\s{2,}", line.strip()) for line in lines]
    return {re.sub(r" \((design|matrix).*\)$", "", row[0]): row[1:] for row in cells if len(row) > 1}


@pytest.mark.parametrize("split", ["train", "validation"])
def test_the_tables_of_costs_agree_with_the_summary(result: ComparisonResult, split: str) -> None:
    text = printed(result)
    assert text.startswith("flower (simulated data), cost final_pose\n")
    found = table(text, f"Cost of 6 {'training' if split == 'train' else 'held-out'} runs")
    for run in summary(result.output)["runs"]:
        if run["matrix"] is not None and run["label"] != "theoretical":
            theoretical, cost, improvement = found[run["label"]]
            assert float(theoretical) == pytest.approx(run[f"theoretical_{split}_cost"], abs=1e-4)
            value, low, high = map(float, re.findall(r"[\d.]+", cost))
            assert value == pytest.approx(run[f"{split}_cost"], abs=1e-4)
            assert low <= value <= high
            assert float(improvement.split(" %")[0]) == pytest.approx(100 * run[f"{split}_improvement"], abs=1e-2)


def test_the_final_errors_are_in_millimetres_and_degrees(result: ComparisonResult) -> None:
    (run,) = (run for run in summary(result.output)["runs"] if run["label"] == "closed_form")
    for split, name in (("train", "training"), ("validation", "held-out")):
        mean, _, heading, _ = table(printed(result), f"Error of the final pose, {name} runs")["closed_form"]
        assert mean == f"{1000 * run[f'{split}_position_m']:.1f}"
        assert heading == f"{math.degrees(run[f'{split}_heading_rad']):.2f}"
    assert "mean (mm)" in printed(result)
    assert "mean (°)" in printed(result)


def test_a_practically_equal_entry_is_marked(result: ComparisonResult) -> None:
    found = table(printed(result, 240), "Entries over their seeds")
    assert found["again"][-1] == "not told apart"
    assert found["theoretical"][-2].startswith("+")
    assert found["theoretical"][-1] == "worse"
    assert found["closed_form"][-1].startswith("best")


def test_a_run_without_an_answer_is_in_every_table_and_told_with_its_reason(result: ComparisonResult) -> None:
    text = printed(result)
    for title in ("Cost of 6 training runs", "Cost of 6 held-out runs"):
        assert table(text, title)["refused (geometry within limits)"][1:] == ["no answer (failed)", "–"]
    assert table(printed(result, 240), "Entries over their seeds")["refused (geometry within limits)"][0] == "0 of 1"
    assert table(text, "The run of each entry")["refused"][:2] == ["1", "failed"]
    assert "no answer: flower refused seed 1: failed: closed_form works on the matrix parameterisation" in text


def test_texts_are_shown_as_they_are(result: ComparisonResult) -> None:
    assert printed(result).count(ODD) == 6


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_narrow_terminal_wraps_words_and_cuts_no_number(result: ComparisonResult, width: int) -> None:
    tables = printed(result, width).split("no answer: ")[0]
    assert "…" not in tables
    assert max(map(len, tables.splitlines())) <= width
    for cell in ("closed_form", "theoretical", "refused", "0.1387"):
        assert cell in tables


def test_forty_columns_keep_the_calibrated_costs_and_the_improvement(result: ComparisonResult) -> None:
    text = printed(result, 40)
    heading = text[text.index("Entry") :].split("─")[0]
    assert "training" in heading
    assert "Improvement" in heading
    assert "design" not in heading
    assert "left out for want of room: Cost, design values;" in " ".join(text.split())


def test_data_sets_are_told_apart_where_there_are_several(tmp_path: Path) -> None:
    sets = {name: {"simulate": flower()} for name in ("one", "two")}
    text = printed(compared_here(tmp_path / "out", datasets=sets, calibrators=["theoretical"]))
    assert [line for line in text.splitlines() if "(simulated data)" in line] == [
        f"{name} (simulated data), cost final_pose" for name in sets
    ]
    assert text.count("Cost of 6 training runs\n") == 2


def test_a_pipe_gets_one_plain_line_for_each_run_and_the_tables(tmp_path: Path) -> None:
    run = compared(write_config(tmp_path, workers=1), tmp_path / "out")
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
    assert table(run.stdout, "Cost of 6 training runs")["closed_form"][0] == "0.13873"


def on_a_terminal(*arguments: object, **others: Any) -> tuple[int, str]:
    """Exit code and everything shown by a command on a terminal of 80 columns."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        env=ENVIRONMENT | {"TERM": "xterm", "COLUMNS": "80", "LINES": "50"},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        **others,
    )
    os.close(theirs)
    shown = b""
    with suppress(OSError):  # the terminal's other end is closed
        while chunk := os.read(ours, 65536):
            shown += chunk
    os.close(ours)
    return process.wait(timeout=PATIENCE), shown.decode()


def test_a_terminal_shows_a_bar_for_all_runs_and_one_for_each_that_is_under_way(tmp_path: Path) -> None:
    entries = ["theoretical", *(search(label, 10_000, batch=10) for label in ("[/b] one", "two"))]
    config = write_config(tmp_path, calibrators=entries, budget={"evaluations": 10_000})
    code, shown = on_a_terminal("compare", config, "--output", tmp_path / "out")
    assert code == 0, shown
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    assert re.search(r"comparing +━+.* 1 of 3", plain)
    assert re.search(r"flower \[/b\] one seed 1 ━+.*[\d,]+ of 10,000, best 0\.\d{6} 0:", plain)
    assert "flower two seed 1: budget, cost 0." in plain
    assert "Traceback" not in plain


def test_twins_under_way_at_the_same_time_have_a_bar_each(tmp_path: Path) -> None:
    twins = [search(label, 8_000, batch=10) for label in ("one", "two")]  # the same work under two names
    config = write_config(tmp_path, calibrators=twins, budget={"evaluations": 8_000})
    code, shown = on_a_terminal("compare", config, "--output", tmp_path / "out")
    assert code == 0, shown
    assert "Traceback" not in shown


def test_a_mistake_on_a_terminal_shows_no_bar(tmp_path: Path) -> None:
    code, shown = on_a_terminal("compare", write_config(tmp_path, calibrators=["nobody"]))
    assert code == 2
    assert shown.startswith("error: config small: calibrators.0: unknown calibrator 'nobody'")
