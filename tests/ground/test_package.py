"""The package as it is imported and started."""

from __future__ import annotations

import ast
import doctest
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from start_up import NUMPY, PACKAGE, ratio
from timing import PATIENCE

import omnibench


@pytest.mark.parametrize("name", omnibench.__all__)
def test_a_public_name_is_found_in_its_module(name: str) -> None:
    found = getattr(omnibench, name)
    assert found.__name__ == name
    assert found.__module__.startswith("omnibench.")


def test_type_checkers_see_the_public_names_in_the_modules_that_they_are_taken_from() -> None:
    statements = ast.walk(ast.parse(Path(omnibench.__file__).read_text(encoding="utf-8")))
    imported = [statement for statement in statements if isinstance(statement, ast.ImportFrom)]
    ours = [statement for statement in imported if (statement.module or "").startswith("omnibench.")]
    seen = {alias.asname: statement.module for statement in ours for alias in statement.names}
    assert seen == {name: getattr(omnibench, name).__module__ for name in omnibench.__all__}


def test_a_name_that_is_not_public_is_missed_by_its_name() -> None:
    package: Any = omnibench  # whose type does not have the name, either
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = package.calibrat


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: omnibench.calibrate("data/robot"),
            "expected a Dataset, found 'data/robot'; .* omnibench.load_dataset",
        ),
        (lambda: omnibench.inspect_dataset(Path("data")), "expected a Dataset, found PosixPath"),
        (lambda: omnibench.discover_effects("data"), "expected a Dataset"),
        (lambda: omnibench.save_dataset("data", "copy"), "expected a Dataset"),
        (lambda: omnibench.evaluate("robot.yaml", "data"), "expected a Calibration, found 'robot.yaml'; .*read_calib"),
        (lambda: omnibench.certify_optimum("robot.yaml", "data"), "expected a Calibration"),
        (lambda: omnibench.export_calibration("robot.yaml", "c_header"), "expected a Calibration"),
        (lambda: omnibench.write_calibration("robot.yaml", "copy.yaml"), "expected a Calibration"),
    ],
)
def test_a_path_in_the_place_of_what_it_holds_is_named(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(omnibench.OmnibenchError, match=message):
        call()


# Stands for Ctrl-C while a package that takes long is still being imported.
INTERRUPTED = """
import sys

class Impatient:
    def find_spec(self, name, path=None, target=None):
        if name == "typer":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Impatient())
from omnibench.__main__ import main
main()
"""


def test_ctrl_c_during_the_first_imports_is_one_line() -> None:
    run = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "interrupted\n")


def test_importing_the_package_loads_no_heavy_library() -> None:
    program = "import sys, omnibench; print(sorted({'numpy', 'polars', 'plotly', 'cvxpy'} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert run.stdout == "[]\n"


def test_importing_the_package_takes_at_most_twice_as_long_as_importing_numpy() -> None:
    _, processor = ratio(PACKAGE, NUMPY, runs=3)
    assert processor <= 2


def test_the_version_is_that_of_the_installed_package() -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "omnibench", "--version"], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert omnibench.__version__ in shown.stdout


@pytest.mark.parametrize("name", omnibench.__all__)
def test_the_examples_of_a_public_name_give_what_they_show(name: str) -> None:
    found = getattr(omnibench, name)
    names = vars(sys.modules[found.__module__]) | {each: getattr(omnibench, each) for each in omnibench.__all__}
    examples = doctest.DocTestFinder(recurse=False).find(found, name, globs=names)
    runner = doctest.DocTestRunner()
    assert sum(runner.run(example).failed for example in examples) == 0
