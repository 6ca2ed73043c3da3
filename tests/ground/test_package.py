"""The package as it is imported and started, and its rooms, whose imports run one way."""

import ast
import doctest
from collections import defaultdict
from collections.abc import Callable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import ROOT
from start_up import NUMPY, PACKAGE, ratio

import omnibench


@pytest.mark.parametrize("name", omnibench.__all__)
def test_a_public_name_is_found_in_its_module(name: str) -> None:
    found = getattr(omnibench, name)
    assert found.__name__.rpartition(".")[2] == name  # check is a room, too
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
        (lambda: omnibench.calibrate("data/robot"), "expected a Dataset, found 'data/robot'; .*load_dataset"),
        (lambda: omnibench.run_comparison("apr02.yaml"), "expected a CompareConfig, .*read_comp"),
        (lambda: omnibench.simulate_dataset("small.yaml"), "expected a RobotConfig, .*read_simul"),
        (lambda: omnibench.LiveNode("live.yaml"), "expected a LiveConfig, .*read_live_config"),
        (lambda: omnibench.References.of([3], end=1.0), r"expected a Reference, found 3; .*Reference\(kind, value,"),
        (lambda: omnibench.inspect_dataset(Path("data")), "expected a Dataset, found PosixPath"),
        (lambda: omnibench.discover_effects("data"), "expected a Dataset"),
        (lambda: omnibench.save_dataset("data", "copy"), "expected a Dataset"),
        (lambda: omnibench.evaluate("robot.yaml", "data"), "expected a Calibration, .*read_calib"),
        (lambda: omnibench.certify_optimum("robot.yaml", "data"), "expected a Calibration"),
        (lambda: omnibench.export_calibration("robot.yaml", "c_header"), "expected a Calibration"),
        (lambda: omnibench.write_calibration("robot.yaml", "copy.yaml"), "expected a Calibration"),
    ],
)
def test_a_path_in_the_place_of_what_it_holds_is_named(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(omnibench.OmnibenchError, match=message):
        call()


CART = omnibench.Robot(
    name="cart",
    wheels=[omnibench.Wheel(name=name, type="fixed", radius=0.05, x=0, y=y) for name, y in (("l", 0.1), ("r", -0.1))],
)
DRIVEN = omnibench.make_dataset(
    "driven",
    CART,
    wheels={"t": np.arange(1, 51) * 0.02, "omega_l": np.full(50, 4.0), "omega_r": np.full(50, 4.0)},
    poses={"t": [0.0, 1.0], "x": [0.0, 0.2], "y": [0.0, 0.0], "theta": [0.0, 0.0]},
)


@cache
def calibration() -> omnibench.Calibration:
    """A calibration for the examples of docstrings, which take it and the data set as given."""
    return omnibench.calibrate(DRIVEN, "least_squares").calibration


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: omnibench.Robot(name="cart"), "^Robot: key 'wheels' is missing$"),
        (lambda: omnibench.Wheel(name="l", radus=1), "^Wheel: unknown key 'radus'; did you mean 'radius'"),
        (lambda: omnibench.Wheel(name="l", type="fixed", radius=-0.05, x=0, y=1), r"^Wheel: radius: .*-0.05\)$"),
        (lambda: omnibench.Budget(seconds=0), r"^Budget: seconds: Input should be greater than 0 \(given: 0\)$"),
        (lambda: omnibench.calibrate(DRIVEN, los="huber"), "unknown key 'los'; did you mean 'loss'"),
        (lambda: omnibench.calibrate(DRIVEN, loss="hubr"), "loss: .*'hubr'.*did you mean 'huber'"),
        (lambda: omnibench.calibrate(DRIVEN, box="rows"), "box.*'rows'.*did you mean 'row'"),
        (lambda: omnibench.calibrate(DRIVEN, unidentified="drop"), "unidentified: .*'drop'"),
        (lambda: omnibench.calibrate(DRIVEN, tolerance=-1), r"tolerance: .*-1"),
        (lambda: omnibench.calibrate(DRIVEN, seed=1.5), r"seed: .*1.5"),
        (lambda: omnibench.calibrate(DRIVEN, box=np.ones(2)), "box"),
        (lambda: omnibench.calibrate(DRIVEN, budget=100), r"budget: .*Budget.*100"),
        (lambda: omnibench.odometry(CART, [1], [[1, 1]], integration="ark"), "unknown integration 'ark'"),
    ],
)
def test_a_wrong_argument_is_refused_in_one_line_that_names_it(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(omnibench.OmnibenchError, match=message):
        call()


def test_a_result_in_the_place_of_what_it_holds_is_told_where_that_lies() -> None:
    run = omnibench.calibrate(DRIVEN)
    with pytest.raises(omnibench.OmnibenchError, match=r"expected a Calibration, found CalibrationRun; take its \.cal"):
        omnibench.evaluate(run, DRIVEN)
    with pytest.raises(omnibench.OmnibenchError, match=r"gap: must be from 0 to 1 \(given: 2\)"):
        omnibench.certify_optimum(run.calibration, DRIVEN, gap=2)


def test_one_folder_of_plug_ins_is_not_taken_for_a_list_of_letters() -> None:
    with pytest.raises(omnibench.OmnibenchError, match="plug-in folder nowhere does not exist"):
        omnibench.load_plugins("nowhere")


def test_importing_the_package_takes_at_most_twice_as_long_as_importing_numpy() -> None:
    _, processor = ratio(PACKAGE, NUMPY, runs=3)
    assert processor <= 2


@pytest.mark.parametrize("name", omnibench.__all__)
def test_examples_of_a_name_give_what_they_show(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = getattr(omnibench, name)
    names = vars(import_module(found.__module__)) | {each: getattr(omnibench, each) for each in omnibench.__all__}
    names |= {"dataset": DRIVEN, "calibration": calibration()}
    methods = [found, *(value.__func__ for value in vars(found).values() if isinstance(value, classmethod))]
    for each in methods if isinstance(found, type) else [found]:
        for example in doctest.DocTestFinder(recurse=False).find(each, name, globs=names):
            assert doctest.DocTestRunner().run(example).failed == 0


MODULES = {".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
           for file in sorted((ROOT / "omnibench").rglob("*.py"))}  # fmt: skip

# What each room may import besides itself and the ground.
BELOW = {
    "robot": {"robot"},
    "data": {"robot"},
    "slam": {"robot", "data"},
    "simulate": {"robot", "data", "slam"},
    "fit": {"robot", "data"},
    "report": {"robot", "data", "slam", "fit", "check"},
    "check": {"robot", "data", "fit"},
    "design": {"robot", "data", "slam", "simulate", "fit", "report"},
    "compare": {"robot", "data", "slam", "simulate", "fit", "report"},
    "discover": {"robot", "data", "slam", "simulate", "fit", "report", "design"},
    "live": {"robot", "data", "simulate", "fit"},
    "testing": {"robot", "data", "fit"},
}
BELOW["cli"] = {*BELOW, "testing"}
GROUND = {"config", "registry", "errors", "files", "processes", "jobs", "environment", "words", "progress", "views"}


@cache
def imports(module: str) -> set[str]:
    """The modules of the package that a module imports, wherever in its text."""
    names = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name in MODULES and name not in (module, "omnibench")}


def room(module: str) -> str:
    return module.split(".")[1] if module.count(".") else ""


@pytest.mark.parametrize("name", [*sorted(BELOW), "the ground"])
def test_a_room_imports_only_rooms_below_it(name: str) -> None:
    importing = GROUND if name == "the ground" else {name}
    allowed = GROUND | BELOW.get(name, set()) | importing
    wrong = [
        f"{module} imports {other}"
        for module in MODULES
        if room(module) in importing
        for other in imports(module)
        if room(other) not in allowed
    ]
    assert not wrong


def test_every_folder_of_the_package_is_a_known_room() -> None:
    assert {room(module) for module in MODULES} - {"", "__main__"} == set(BELOW) | GROUND


def test_imports_run_in_no_circle() -> None:
    graph: dict[str, set[str]] = defaultdict(set)
    for module in MODULES:
        graph[module] = {other for other in imports(module) if not module.startswith(f"{other}.")}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circle: {' -> '.join(error.args[1])}")
