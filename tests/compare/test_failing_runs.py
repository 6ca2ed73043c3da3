"""Calibrators that misbehave: each is a row with its outcome and reason, and the others run."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from commands import Command, compared, compared_here, rows, summary, write_config, write_plugin

from omnibench.errors import OmnibenchError

CALIBRATOR = """
@calibrators.register("{name}")
class Misbehaving(Calibrator):
    "Misbehaves."

    def calibrate(self, problem):
        {body}
"""
BODIES = {
    "raises": "raise ValueError('first line\\n second line')",
    "quits": "sys.exit('enough')",
    "interrupts": "raise KeyboardInterrupt",
    "says_nan": "return Solution(np.full(problem.size, np.nan), 'here')",
    "says_infinity": "return Solution(problem.start * np.inf, 'here')",
    "says_words": "return Solution('nowhere', 'here')",
    "says_too_little": "return Solution(problem.start[:3], 'here')",
    "leaves_the_box": "return Solution(problem.upper + 1.0, 'here')",
    "says_nothing": "return None",
    "gives_odd_reasons": "return Solution(problem.start, {'two': 'lines\\nhere'})",
    "spoils_the_history": "problem.history = [1, 2]; return Solution(problem.start, 'here')",
    "dies": "os._exit(3)",
    "is_killed": "os.kill(os.getpid(), 9)",
    "closes_everything": "os.closerange(3, 256); time.sleep(60)",
    "leaves_a_thread": "threading.Timer(60, print).start(); return Solution(problem.start, 'here')",
    "wants_memory": "np.ones(10**9)",
    "wants_memory_bit_by_bit": "held = [bytes(10**5) for _ in range(10**9)]",
}
UNMAKEABLE = """
@calibrators.register("unmakeable")
class Unmakeable(Calibrator):
    "Cannot be made."

    def __init__(self, options):
        raise RuntimeError("not today")

    def calibrate(self, problem): ...
"""
BROKEN = """
import a_package_that_nobody_has

@calibrators.register("of_another_name")
class Broken(Calibrator): ...
"""
NO_CALIBRATOR = """
@calibrators.register("no_calibrator")
class NoCalibrator: ...
"""
WITH_ANSWER = ("theoretical", "closed_form", "leaves_a_thread", "gives_odd_reasons")
WITHOUT_ANSWER = {*BODIES} - {*WITH_ANSWER} | {
    "unmakeable",
    "broken",
    "of_another_name",
    "no_calibrator",
}


class Compared(NamedTuple):
    output: Path
    run: subprocess.CompletedProcess[str]
    rows: dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """One comparison of everything that can go wrong, and of two calibrators with which nothing does."""
    folder = tmp_path_factory.mktemp("failing")
    plugins = folder / "plugins"
    for name, body in BODIES.items():
        write_plugin(plugins, name, CALIBRATOR.format(name=name, body=body))
    write_plugin(plugins, "unmakeable", UNMAKEABLE)
    write_plugin(plugins, "broken", BROKEN)
    write_plugin(plugins, "no_calibrator", NO_CALIBRATOR)
    config = write_config(
        folder,
        plugins=["plugins"],
        calibrators=[*WITH_ANSWER, *sorted(WITHOUT_ANSWER)],
        budget={"evaluations": 500, "seconds": 60},
        workers=4,
        memory_mb=1000,
    )
    run = compared(config, folder / "out")
    return Compared(folder / "out", run, rows(folder / "out"))


def test_every_entry_is_a_row(comparison: Compared) -> None:
    assert {*comparison.rows} == WITHOUT_ANSWER | {*WITH_ANSWER}


def test_the_others_run(comparison: Compared) -> None:
    assert comparison.rows["closed_form"]["outcome"] == "converged"
    assert comparison.rows["theoretical"]["outcome"] == "converged"


@pytest.mark.parametrize(
    ("label", "outcome", "reason"),
    [
        ("raises", "failed", "ValueError: first line second line"),
        ("quits", "failed", "SystemExit: enough"),
        ("interrupts", "failed", "KeyboardInterrupt"),
        ("says_nan", "invalid", "the answer holds NaN or infinity"),
        ("says_infinity", "invalid", "the answer holds NaN or infinity"),
        ("says_words", "invalid", "the answer is not a vector of numbers"),
        ("says_too_little", "invalid", "the answer has shape (3,), expected (9,)"),
        ("leaves_the_box", "invalid", "the answer is outside the box (m11, m12, "),
        ("says_nothing", "failed", "calibrate returned NoneType, expected a Solution"),
        ("gives_odd_reasons", "converged", "{'two': 'lines"),
        ("spoils_the_history", "failed", "Expected `Improvement`"),
        ("dies", "failed", "the process died without an answer (exit code 3)"),
        ("is_killed", "failed", "the process died without an answer (killed by SIGKILL"),
        ("closes_everything", "failed", "the process died without an answer"),
        ("leaves_a_thread", "converged", "here"),
        ("wants_memory", "failed", "out of memory (limit 1000 MB)"),
        ("wants_memory_bit_by_bit", "failed", "out of memory (limit 1000 MB)"),
        ("unmakeable", "failed", "calibrator 'unmakeable' cannot be made: RuntimeError: not today"),
        ("broken", "failed", "cannot be imported: ModuleNotFoundError: No module named 'a_package_that_nobody_has'"),
        ("of_another_name", "failed", "broken.py cannot be imported: ModuleNotFoundError"),
        ("no_calibrator", "failed", "the class must derive from Calibrator"),
    ],
)
def test_the_row_has_outcome_and_reason(comparison: Compared, label: str, outcome: str, reason: str) -> None:
    row = comparison.rows[label]
    assert row["outcome"] == outcome
    assert reason in row["reason"]
    assert "\n" not in row["reason"]


@pytest.mark.parametrize("label", sorted(WITHOUT_ANSWER))
def test_a_row_without_an_answer_has_no_costs_and_no_matrix(comparison: Compared, label: str) -> None:
    row = comparison.rows[label]
    assert {row[name] for name in ("train_cost", "validation_cost", "train_improvement", "gap")} == {None}
    assert row["matrix"] is None
    assert row["theoretical_train_cost"] == comparison.rows["theoretical"]["train_cost"]


@pytest.mark.parametrize("label", sorted(WITHOUT_ANSWER))
def test_the_terminal_shows_the_row_and_why(comparison: Compared, label: str) -> None:
    row = comparison.rows[label]
    assert f"no answer: flower {label} seed 1: {row['outcome']}: {row['reason']}" in comparison.run.stdout
    assert f"flower {label} seed 1: {row['outcome']}, no answer" in comparison.run.stderr


def test_a_plugin_that_cannot_be_imported_is_named_with_its_error(comparison: Compared) -> None:
    warning = f"{comparison.output.parent / 'plugins' / 'broken.py'} cannot be imported: ModuleNotFoundError: No module"
    assert f"warning: plug-in {warning}" in comparison.run.stderr
    assert any(warning in text for text in summary(comparison.output)["warnings"])


def test_failed_runs_are_not_kept_and_the_others_are(comparison: Compared) -> None:
    kept = sum(row["outcome"] != "failed" for row in comparison.rows.values())
    assert len(list((comparison.output / "runs").iterdir())) == kept


def test_when_everything_fails_there_are_results_and_exit_code_1(command: Command, tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "raises", CALIBRATOR.format(name="raises", body=BODIES["raises"]))
    config = write_config(tmp_path, plugins=[str(plugins)], calibrators=["raises"])
    run = command("compare", config, "--output", tmp_path / "out")
    assert run.returncode == 1
    assert rows(tmp_path / "out")["raises"]["outcome"] == "failed"
    assert (tmp_path / "out" / "report.html").is_file()


def test_when_every_search_fails_beside_the_design_values_the_exit_code_is_1_and_a_long_message_is_cut(
    command: Command, tmp_path: Path
) -> None:
    body = "raise ValueError(5_000_000 * 'x')"
    plugins = write_plugin(tmp_path / "plugins", "shouts", CALIBRATOR.format(name="shouts", body=body))
    config = write_config(tmp_path, plugins=[str(plugins)], calibrators=["theoretical", "shouts"])
    run = command("compare", config, "--output", tmp_path / "out")
    assert run.returncode == 1
    assert "every search failed, the first: flower shouts seed 1: failed: ValueError: xxx" in run.stderr
    assert "more characters)" in rows(tmp_path / "out")["shouts"]["reason"]
    assert max(map(len, (run.stdout + run.stderr).splitlines())) < 3000
    assert (tmp_path / "out" / "report.html").stat().st_size < 8_000_000


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"calibrators": ["of_a_third_name"]}, "unknown calibrator 'of_a_third_name'"),
        ({"cost": "of_a_third_name"}, "unknown cost 'of_a_third_name'"),
        (
            {"datasets": {"x": {"import": {"format": "of_a_third_name", "source": "."}}}},
            "unknown importer 'of_a_third_name'",
        ),
    ],
    ids=["calibrator", "cost", "importer"],
)
def test_an_unknown_name_beside_a_broken_plugin_names_both(changes: dict[str, Any], name: str, tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "broken", BROKEN)
    with pytest.raises(OmnibenchError) as failure:
        compared_here(tmp_path / "out", plugins=[str(plugins)], **changes)
    assert name in str(failure.value)
    assert "broken.py cannot be imported: ModuleNotFoundError" in str(failure.value)
    assert "\n" not in str(failure.value)
