"""Calibrators that misbehave: each is a row with its outcome and reason, and the others run."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import pytest
from commands import Command, Printed, compared_here, refused, rows, run_here, summary, write_config, write_plugin

from omnibench.errors import OmnibenchError

CALIBRATOR = """
@calibrators.register("{name}")
class Misbehaving(Calibrator):
    "Misbehaves."

    def calibrate(self, problem):
        {body}
"""
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
WELL_BEHAVED = {"theoretical": ("", "converged", ""), "closed_form": ("", "converged", "")}
# What calibrate does or the whole plug-in, the outcome, and a part of the reason.
WRONG = {
    "raises": ("raise ValueError('first line\\n second line')", "failed", "ValueError: first line second line"),
    "quits": ("sys.exit('enough')", "failed", "SystemExit: enough"),
    "interrupts": ("raise KeyboardInterrupt", "failed", "KeyboardInterrupt"),
    "says_nan": ("return Solution(np.full(problem.size, np.nan), 'here')", "invalid", "NaN"),
    "says_infinity": ("return Solution(problem.start * np.inf, 'here')", "invalid", "infinity"),
    "says_words": ("return Solution('nowhere', 'here')", "invalid", "not a vector"),
    "says_too_little": ("return Solution(problem.start[:3], 'here')", "invalid", "(3,), expected (9,)"),
    "leaves_the_box": ("return Solution(problem.upper + 1.0, 'here')", "invalid", "outside the box (m11, m12, "),
    "says_nothing": ("return None", "failed", "NoneType"),
    "gives_odd_reasons": ("return Solution(problem.start, {'two': 'lines\\nhere'})", "converged", "{'two': 'lines"),
    "spoils_the_history": (
        "problem.history[:] = [1, 2]; return Solution(problem.start, 'here')",
        "failed",
        "Expected `Improvement`",
    ),
    "dies": ("os._exit(3)", "failed", "(exit code 3)"),
    "unmakeable": (UNMAKEABLE, "failed", "RuntimeError: not today"),
    "broken": (BROKEN, "failed", "ModuleNotFoundError: No module named 'a_package_that_nobody_has'"),
    "of_another_name": ("", "failed", "broken.py cannot be imported: ModuleNotFoundError"),
    "no_calibrator": (NO_CALIBRATOR, "failed", "derive from Calibrator"),
}
DEADLY = {
    "is_killed": ("os.kill(os.getpid(), 9)", "failed", "(killed by SIGKILL"),
    "closes_everything": ("os.closerange(3, 256); time.sleep(60)", "failed", "died without an answer"),
    "leaves_a_thread": (
        "threading.Timer(60, print).start(); return Solution(problem.start, 'here')",
        "converged",
        "here",
    ),
    "wants_memory": ("np.ones(10**9)", "failed", "(limit 1000 MB)"),
    "wants_memory_bit_by_bit": ("held = [bytes(10**5) for _ in range(10**9)]", "failed", "(limit 1000 MB)"),
    "hangs": ("time.sleep(3600)", "time", "ended by force: 5 s"),
}


class Compared(NamedTuple):
    output: Path
    run: Printed
    rows: dict[str, dict[str, Any]]
    expected: dict[str, tuple[str, str, str]]


@pytest.fixture(scope="module", params=[WRONG, pytest.param(DEADLY, marks=pytest.mark.slow)], ids=["wrong", "deadly"])
def comparison(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """One comparison of everything that can go wrong, and of two calibrators with which nothing does."""
    folder = tmp_path_factory.mktemp("failing")
    for name, (body, _, _) in request.param.items():
        if body:
            plugin = body if "@calibrators" in body else CALIBRATOR.format(name=name, body=body)
            write_plugin(folder / "plugins", name, plugin)
    entries = [*WELL_BEHAVED, *request.param]
    limits = {"budget": {"evaluations": 500, "seconds": 5}, "memory_mb": 1000, "workers": 4}
    config = write_config(folder, plugins=["plugins"], calibrators=entries, **limits)
    run = run_here("compare", config, "--output", folder / "out", cwd=folder)
    assert run.returncode == 0
    return Compared(folder / "out", run, rows(folder / "out"), WELL_BEHAVED | request.param)


def test_every_entry_is_a_row_with_its_outcome_and_reason(comparison: Compared) -> None:
    assert {*comparison.rows} == {*comparison.expected}
    for label, (_, outcome, reason) in comparison.expected.items():
        assert comparison.rows[label]["outcome"] == outcome, label
        assert reason in comparison.rows[label]["reason"], label
        assert "\n" not in comparison.rows[label]["reason"]


def test_a_row_without_an_answer_has_no_costs_and_no_matrix_and_is_shown_with_its_reason(comparison: Compared) -> None:
    for label, row in comparison.rows.items():
        if row["outcome"] == "converged":
            continue
        assert {row[name] for name in ("train_cost", "validation_cost", "train_improvement", "gap")} == {None}
        assert row["matrix"] is None
        assert row["theoretical_train_cost"] == comparison.rows["theoretical"]["train_cost"]
        assert f"no answer: flower {label} seed 1: {row['outcome']}: {row['reason']}" in comparison.run.stdout
        assert f"flower {label} seed 1: {row['outcome']}, no answer" in comparison.run.stderr


def test_a_plugin_that_cannot_be_imported_is_named_with_its_error(comparison: Compared) -> None:
    warning = f"{comparison.output.parent / 'plugins' / 'broken.py'} cannot be imported: ModuleNotFoundError: No module"
    broken = "broken" in comparison.expected
    assert (f"warning: plug-in {warning}" in comparison.run.stderr) == broken
    assert any(warning in text for text in summary(comparison.output)["warnings"]) == broken


def test_failed_runs_are_not_kept_and_the_others_are(comparison: Compared) -> None:
    kept = sum(row["outcome"] != "failed" for row in comparison.rows.values())
    assert len(list((comparison.output / "runs").iterdir())) == kept


@pytest.mark.parametrize("others", [[], ["theoretical"]])
def test_when_every_search_fails_there_are_results_and_exit_code_1_and_a_long_message_is_cut(
    others: list[str], command: Command, tmp_path: Path
) -> None:
    body = "raise ValueError(5_000_000 * 'x')"
    plugins = write_plugin(tmp_path / "plugins", "shouts", CALIBRATOR.format(name="shouts", body=body))
    config = write_config(tmp_path, plugins=[str(plugins)], calibrators=[*others, "shouts"])
    run = command("compare", config, "--output", tmp_path / "out")
    assert run.returncode == 1
    assert "flower shouts seed 1: failed: ValueError: xxx" in run.stdout + run.stderr
    assert "more characters)" in rows(tmp_path / "out")["shouts"]["reason"]
    assert max(map(len, (run.stdout + run.stderr).splitlines())) < 3000
    assert (tmp_path / "out" / "report.html").stat().st_size < 8_000_000


@pytest.mark.parametrize(
    "changes",
    [
        {"calibrators": ["of_a_third_name"]},
        {"cost": "of_a_third_name"},
        {"datasets": {"x": {"import": {"format": "of_a_third_name", "source": "."}}}},
    ],
    ids=["calibrator", "cost", "importer"],
)
def test_an_unknown_name_beside_a_broken_plugin_names_both(changes: dict[str, Any], tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "broken", BROKEN)
    with refused(OmnibenchError, "'of_a_third_name'", "broken.py cannot be imported: ModuleNotFoundError"):
        compared_here(tmp_path / "out", plugins=[str(plugins)], **changes)
