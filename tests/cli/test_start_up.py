"""What happens before a command begins its work, and equations without a finite solution: one line each."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from commands import python
from scipy.linalg.lapack import dtbtrs

import omnibench
from omnibench.__main__ import _run
from omnibench.errors import computable

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
    return set(python(LOADED.format(statements=statements)).stderr.split())


def test_the_help_imports_typer_and_nothing_else() -> None:
    shown = "sys.argv = ['omnibench', '--help']; from omnibench.__main__ import main; main()"
    assert packages(shown) - packages("import typer, rich") == {"omnibench"}


def test_loading_the_plug_ins_imports_neither_discover_nor_numba_nor_the_optimisers() -> None:
    plugins = Path(__file__).parents[2] / "plugins"
    loaded = python(
        "import sys; from omnibench.registry import load_plugins; load_plugins(sys.argv[1])\nprint(*sys.modules)",
        plugins,
    ).stdout.split()
    assert "omnibench.fit.calibrators.closed_form" in loaded
    assert {"numba", "scipy.optimize", "scipy.stats", "omnibench.discover.discover"}.isdisjoint(loaded)


def test_a_plugin_that_prints_does_not_spoil_what_check_prints(tmp_path: Path) -> None:
    (tmp_path / "chatty.py").write_text("print('hello')\n")
    program = "import sys; sys.argv = ['omnibench', 'check', 'nowhere', '--plugin', sys.argv[1]]\n"
    shown = python(program + "from omnibench.__main__ import main; main()", tmp_path / "chatty.py")
    assert (shown.returncode, shown.stdout) == (2, "")
    assert shown.stderr.startswith("hello\n")


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


LOADING = (("calibrate", "data"), ("discover", "data"), ("inspect", "data"), ("live", "node.yaml"))
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
    run = python(PROGRAM.format(name="/usr/bin/omnibench", before=before))
    assert (run.returncode, run.stderr) == (130, "interrupted\n")


def test_the_program_takes_ctrl_c_over_before_it_imports_anything_that_takes_time() -> None:
    listed = "import sys; before = {*sys.modules}; from omnibench.__main__ import main; print(*{*sys.modules} - before)"
    run = python(listed)
    assert set(run.stdout.split()) == {"__future__", "gc", "omnibench", "omnibench.__main__"}


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("typer", ["--help"]),
        ("numpy", ["compare", "config.yaml"]),
        *(pytest.param("numpy", [*typed], marks=pytest.mark.slow) for typed in LOADING),
        pytest.param("pydantic", ["list"], marks=pytest.mark.slow),
        pytest.param("omnibench.cli.handbook_topics", ["guide"], marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_during_the_imports_of_a_command_is_one_line(module: str, arguments: list[str]) -> None:
    run = python(INTERRUPTED.format(module=module, arguments=arguments))
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "interrupted\n")


UNKNOWN = np.full((3, 3), np.nan)


@pytest.mark.parametrize(
    "compute",
    [
        lambda: np.linalg.eigh(UNKNOWN),
        lambda: np.linalg.svd(UNKNOWN),
        lambda: np.linalg.inv(np.zeros((2, 2))),
        lambda: np.linalg.cholesky(-np.eye(2)),
        lambda: scipy.linalg.inv(UNKNOWN),
        lambda: dtbtrs(np.ones((2, 3)), np.ones((2, 1))),
    ],
    ids=["eigenvalues", "singular values", "inverse", "Cholesky factor", "SciPy", "LAPACK"],
)
def test_failing_linear_algebra_is_one_line(compute: Callable[[], object], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        _run(SimpleNamespace(main=lambda **_: compute()))
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: the equations have no finite solution; omnibench check DATASET says")


@pytest.mark.parametrize("name", ["calibrate", "check", "discover_effects", "evaluate"])
def test_from_python_it_is_one_of_the_errors_that_are_told(name: str) -> None:
    function = getattr(omnibench, name)
    assert function is not function.__wrapped__
    with pytest.raises(omnibench.OmnibenchError, match="no finite solution"):
        computable(lambda: np.linalg.inv(np.zeros((2, 2))))()


def test_other_mistakes_of_the_program_stay_visible() -> None:
    with pytest.raises(ValueError, match="broadcast"):
        _run(SimpleNamespace(main=lambda **_: np.zeros(2) + np.zeros(3)))


# Stands for a Ctrl-C that comes while a finalizer or a callback of the garbage collector runs.
IGNORED = """
import signal, sys, time

class Finalized:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == "pydantic":
            Finalized()
            time.sleep(60)

sys.meta_path.insert(0, Slow())
sys.argv = ["omnibench", "list"]
from omnibench.__main__ import main
main()
"""


def test_ctrl_c_where_python_ignores_exceptions_ends_the_command_soon_after() -> None:
    run = python(IGNORED)
    assert (run.returncode, run.stdout) == (130, "")
    assert run.stderr.split() == ["interrupted;", "the", "same", "command", "begins", "anew"]
