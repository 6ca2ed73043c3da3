"""The house: rooms whose imports run one way."""

from __future__ import annotations

import ast
from collections import Counter, defaultdict
from graphlib import CycleError, TopologicalSorter

import pytest
from commands import ROOT

PACKAGE = ROOT / "omnibench"
MODULES = {".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
           for file in sorted(PACKAGE.rglob("*.py"))}  # fmt: skip

# What each room may import besides itself and the ground.
BELOW = {
    "robot": {"robot"},
    "data": {"robot"},
    "slam": {"robot", "data"},
    "simulate": {"robot", "data", "slam"},
    "fit": {"robot", "data"},
    "report": {"robot", "data", "slam", "fit"},
    "design": {"robot", "data", "slam", "simulate", "fit", "report"},
    "compare": {"robot", "data", "slam", "simulate", "fit", "report"},
    "study": {"robot", "data", "slam", "simulate", "fit", "report", "compare"},
    "discover": {"robot", "data", "simulate", "fit", "report"},
    "live": {"robot", "data", "simulate"},
    "testing": {"robot", "data", "fit"},
    "notebook": {"robot", "data", "slam", "simulate", "fit", "report", "design", "compare", "discover"},
    "cli": {
        "robot",
        "data",
        "slam",
        "simulate",
        "fit",
        "report",
        "design",
        "compare",
        "study",
        "discover",
        "live",
        "testing",
    },
}
GROUND = {"config", "registry", "errors", "files", "processes", "jobs", "environment", "words", "progress", "views"}
CONVENTIONAL = {"__init__", "config", "output", "result", "tables", "wording"}  # one in a room, the same in each


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


@pytest.mark.parametrize("name", sorted(BELOW))
def test_a_room_imports_only_rooms_below_it(name: str) -> None:
    wrong = [
        f"{module} imports {other}"
        for module in MODULES
        if room(module) == name
        for other in imports(module)
        if room(other) not in BELOW[name] | GROUND | {name}
    ]
    assert not wrong


def test_the_ground_imports_no_room() -> None:
    wrong = [
        f"{module} imports {other}"
        for module in MODULES
        if room(module) in GROUND
        for other in imports(module)
        if room(other) not in GROUND
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


def test_module_names_are_unique_but_for_the_conventional_ones() -> None:
    counts = Counter(file.stem for file in MODULES.values())
    assert {name for name, count in counts.items() if count > 1} <= CONVENTIONAL


def test_no_module_is_called_utils_or_helpers() -> None:
    assert not {file.stem for file in MODULES.values()} & {"utils", "util", "helpers", "helper", "misc", "common"}
