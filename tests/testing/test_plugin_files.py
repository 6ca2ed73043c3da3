"""Writing the first version of a plug-in, and checking one."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest
from commands import ENVIRONMENT, python, refused
from timing import PATIENCE

from omnibench.errors import ConfigError, DataError, OmnibenchError, PluginError
from omnibench.registry import registered_from
from omnibench.testing import CaseOutcome, load_plugin
from omnibench.testing.plugin_files import PLUGIN_KINDS, CheckReport, check_plugin, check_plugin_apart, new_plugin

FLAWED = """
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.registry import calibrators


@calibrators.register("flawed_{number}")
class Flawed(Calibrator):
    '''Answers from outside the box.'''

    def calibrate(self, problem):
        problem.cost(problem.start[None])
        return Solution(2 * problem.start + 1, "somewhere")
"""


CRASHING = FLAWED.format(number=7).replace("problem.cost(problem.start[None])", "import os; os._exit(4)")


def outcomes(report: CheckReport) -> dict[str, CaseOutcome]:
    return {result.case: result.outcome for result in report.results}


@pytest.mark.parametrize("kind", PLUGIN_KINDS)
def test_a_new_plugin_passes_its_check(kind: str, tmp_path: Path) -> None:
    written = new_plugin("my_first", kind, tmp_path / "made" / "for_it")
    assert [path.name for path in written] == ["my_first.py", "test_my_first.py"]
    report = check_plugin(written[0])
    assert report.passed, report.failures
    assert {(result.kind, result.name) for result in report.results} == {(kind, "my_first")}


@pytest.mark.slow
def test_the_tests_of_new_plugins_pass_in_pytest(tmp_path: Path) -> None:
    for kind in PLUGIN_KINDS:
        new_plugin(f"my_{kind}", kind, tmp_path)
    program = "import sys, pytest; sys.exit(pytest.main(sys.argv[1:]))"
    run = python(program, "-v", "-p", "no:cacheprovider", tmp_path, cwd=tmp_path, env=ENVIRONMENT)
    assert run.returncode == 0, run.stdout + run.stderr
    assert run.stdout.count("SKIPPED") == 3  # the seed of a calibrator that is stochastic, other kinds of effects
    assert all(f"test_my_{kind}.py" in run.stdout for kind in PLUGIN_KINDS)


@pytest.mark.slow
def test_the_cases_run_where_pytest_is_not_installed(tmp_path: Path) -> None:
    new_plugin("bare_search", "calibrator", tmp_path)
    program = (
        "import sys; sys.modules['pytest'] = None\n"
        "from omnibench.testing.plugin_files import check_plugin\n"
        f"print(check_plugin({str(tmp_path / 'bare_search.py')!r}).passed)"
    )
    run = python(program)
    assert run.stdout == "True\n", run.stderr


@pytest.mark.parametrize("kind", PLUGIN_KINDS)
def test_a_new_plugin_whose_class_would_hide_an_import_is_called_otherwise(kind: str, tmp_path: Path) -> None:
    name = {"calibrator": "solution", "importer": "trajectory_", "cost": "cost_", "effect": "signals"}[kind]
    file, _ = new_plugin(name, kind, tmp_path)
    load_plugin(file)
    ((_, entry),) = registered_from(file)
    assert entry.cls.__name__ == f"{name.strip('_').capitalize()}{kind.capitalize()}"


@pytest.mark.parametrize(
    ("name", "kind", "folder", "named"),
    [
        *(
            (name, "calibrator", "", "cannot name a plug-in")
            for name in ("my-search", "2opt", "My", "class", "", "_private", "test_mine", "größe", "../x")
        ),
        ("theoretical", "calibrator", "", r"'theoretical' already \(built in\)"),
        ("random", "calibrator", "", "Python module 'random'"),
        ("mine", "calibrater", "", "'calibrater'; did you mean 'calibrator'"),
        ("mine", "calibrator", "", r"test_mine\.py"),
        ("mine", "calibrator", "test_mine.py", "cannot be written"),
    ],
)
def test_what_cannot_be_written_is_named(name: str, kind: str, folder: str, named: str, tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text("mine")
    with pytest.raises((ConfigError, DataError), match=named):
        new_plugin(name, kind, tmp_path / folder)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_flawed_plugins_fail_the_case_they_break(tmp_path: Path) -> None:
    (tmp_path / "two.py").write_text(FLAWED.format(number=1) + FLAWED.format(number=2))
    report = check_plugin(tmp_path / "two.py")
    assert {result.name for result in report.results} == {"flawed_1", "flawed_2"}
    assert not report.passed
    assert outcomes(report)["it works in silence"] is CaseOutcome.PASSED
    failures = [result for result in report.failures if result.case == "bounds are kept"]
    assert [(failure.kind, failure.name) for failure in failures] == [("calibrator", f"flawed_{k}") for k in (1, 2)]
    assert failures[0].message.startswith("the answer is outside the box (m11")
    demanding = "    class Options(Options):\n        rate: float\n\n    def calibrate"
    content = FLAWED.format(number=5).replace("    def calibrate", demanding)
    (tmp_path / "demanding.py").write_text("from omnibench.registry import Options\n" + content)
    (result,) = check_plugin(tmp_path / "demanding.py").results
    assert "'flawed_5': key 'rate' is missing" in result.message


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("import os; os._exit(3)", "exit code 3"),
        pytest.param("import os; os.kill(os.getpid(), 11)", "SIGSEGV", marks=pytest.mark.slow),
        pytest.param("while True: pass", "limit 1 s", marks=pytest.mark.slow),
        pytest.param("1 / 0", "ZeroDivisionError: division by zero", marks=pytest.mark.slow),
        pytest.param(CRASHING, "exit code 4) while calibrator flawed_7 is tested", marks=pytest.mark.slow),
    ],
    ids=["exit", "crash", "hang", "error", "exit in a case"],
)
def test_a_plugin_that_ends_its_process_or_never_ends_is_named(content: str, named: str, tmp_path: Path) -> None:
    file = tmp_path / "wild.py"
    file.write_text(content)
    with pytest.raises(PluginError, match=re.escape(named)):
        check_plugin_apart(file, seconds=1.0 if "limit" in named else PATIENCE)


@pytest.mark.slow
@pytest.mark.parametrize("child", ["time.sleep(10_000)", "pass"], ids=["that stays", "that goes on as its twin"])
def test_a_fork_is_named_and_ended(child: str, tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    fork = f"import os, time\npid = os.fork()\nif pid == 0:\n    {child}\n"
    note = f"else:\n    open({str(pid_file)!r}, 'w').write(str(pid))\n"
    (tmp_path / "forking.py").write_text(fork + note + FLAWED.format(number=8))
    report = check_plugin_apart(tmp_path / "forking.py", seconds=PATIENCE)
    assert outcomes(report)["it leaves no process behind"] is CaseOutcome.FAILED
    assert len([result for result in report.results if result.case == "bounds are kept"]) == 1
    until_gone(int(pid_file.read_text()))


def until_gone(pid: int) -> None:
    deadline = time.monotonic() + PATIENCE
    while Path(f"/proc/{pid}").exists() and " Z " not in Path(f"/proc/{pid}/stat").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("import nowhere_at_all\n", "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("def broken(:\n", "SyntaxError"),
        ("raise SystemExit(3)\n", "SystemExit: 3"),
        ("import numpy\n", "registers nothing"),
        (FLAWED.format(number=4).replace("flawed_4", "genetic"), "'genetic' is registered already"),
        (None, "no such file"),
    ],
)
def test_a_file_without_a_working_plugin_is_one_line(content: str | None, message: str, tmp_path: Path) -> None:
    file = tmp_path / "faulty.py"
    if content is not None:
        file.write_text(content)
    with refused(OmnibenchError, message, str(file)):
        check_plugin(file)


def test_an_importer_is_checked_on_the_sample_that_is_given(tmp_path: Path) -> None:
    new_plugin("sampled", "importer", tmp_path)
    rows = "\n".join(f"{0.1 * k:.1f},0,0,{0.05 * k:.2f},2,2,2" for k in range(11))
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "one.csv").write_text(f"t,x,y,heading,a,b,c\n{rows}\n")
    report = check_plugin(tmp_path / "sampled.py", tmp_path / "runs")
    assert set(outcomes(report).values()) == {CaseOutcome.PASSED}
