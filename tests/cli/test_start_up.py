"""What happens before a command begins its work: quick help, and Ctrl-C while libraries are still being imported."""

from __future__ import annotations

import subprocess
import sys

import pytest
from timing import PATIENCE

LOADED = """
import sys
try:
    {statements}
finally:
    names = {{name.split(".")[0] for name in sys.modules}}
    print(*sorted(names - set(sys.stdlib_module_names)), file=sys.stderr)
"""


def packages(statements: str) -> set[str]:
    """Names of the packages outside the standard library that the statements import."""
    run = subprocess.run(
        [sys.executable, "-c", LOADED.format(statements=statements)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    return set(run.stderr.split())


def test_the_help_imports_typer_and_nothing_else() -> None:
    shown = "sys.argv = ['omnibench', '--help']; from omnibench.__main__ import main; main()"
    assert packages(shown) - packages("import typer, rich") == {"omnibench"}


# Stands for a library that is still being imported when Ctrl-C comes, and turns it into an error of its own.
INTERRUPTED = """
import signal, sys

class Impatient:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                raise ImportError("half imported")

sys.meta_path.insert(0, Impatient())
sys.argv = ["omnibench", *{arguments!r}]
from omnibench.__main__ import main
main()
"""


PROGRAM = """
import signal, sys
sys.argv = [{name!r}, "--version"]
from omnibench.__main__ import main
{before}
try:
    main()
finally:
    signal.raise_signal(signal.SIGINT)
"""


@pytest.mark.parametrize("before", ["signal.raise_signal(signal.SIGINT)", ""], ids=["before", "after"])
def test_ctrl_c_before_and_after_the_work_of_the_program_is_one_line(before: str) -> None:
    program = PROGRAM.format(name="/usr/bin/omnibench", before=before)
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (run.returncode, run.stderr) == (130, "interrupted\n")


def test_the_program_takes_ctrl_c_over_before_it_imports_anything_that_takes_time() -> None:
    listed = "import sys; before = {*sys.modules}; from omnibench.__main__ import main; print(*{*sys.modules} - before)"
    run = subprocess.run([sys.executable, "-c", listed], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert set(run.stdout.split()) == {"__future__", "gc", "omnibench", "omnibench.__main__"}


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("typer", ["--help"]),
        ("numpy", ["compare", "config.yaml"]),
        ("numpy", ["calibrate", "data"]),
        ("numpy", ["discover", "data"]),
        ("numpy", ["inspect", "data"]),
        ("numpy", ["live", "node.yaml"]),
        ("pydantic", ["list"]),
        ("omnibench.cli.handbook_topics", ["guide"]),
    ],
)
def test_ctrl_c_during_the_imports_of_a_command_is_one_line(module: str, arguments: list[str]) -> None:
    program = INTERRUPTED.format(module=module, arguments=arguments)
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "interrupted\n")
