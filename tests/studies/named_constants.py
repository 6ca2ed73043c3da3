"""The numbers that modules name in capitals, and their variation: what studies of constants share."""

from __future__ import annotations

import ast
import importlib
import pkgutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from omnibench.robot.calibration import Noise


@dataclass(frozen=True)
class Constant:
    """A number, or several, that a module of a package names in capitals."""

    package: str
    module: str
    name: str
    value: Any

    @property
    def title(self) -> str:
        return f"{self.module.removeprefix(self.package + '.')}.{self.name}"

    def times(self, factor: float) -> Any:
        """The number times a factor: whole ones stay whole; of a share above one half, the rest to 1 is multiplied."""
        return _times(self.value, factor)

    @contextmanager
    def varied(self, factor: float) -> Iterator[None]:
        """The constant at another value in its module, and under a public name in all that import it."""
        modules = [
            each for each in modules_of(self.package) if each.__name__ == self.module or not self.name.startswith("_")
        ]
        holding = [each for each in modules if hasattr(each, self.name)]
        for module in holding:
            _set(module, self.name, self.times(factor))
        try:
            yield
        finally:
            for module in holding:
                _set(module, self.name, self.value)


def constants_of(package: str, leave_out: Sequence[str] = ()) -> list[Constant]:
    """All numbers in capitals of a package or module; leave_out: modules whose names begin so."""
    found = []
    for module in modules_of(package, leave_out):
        for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
            names = [each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]
            for name in names if isinstance(node, ast.Assign | ast.AnnAssign) else ():
                value = getattr(module, name)
                if name == name.upper() and _is_number(value):
                    found.append(Constant(package, module.__name__, name, value))
    return found


def modules_of(package: str, leave_out: Sequence[str] = ()) -> list[ModuleType]:
    """A package's modules, or a module that is none; leave_out: those whose names begin so."""
    whole = importlib.import_module(package)
    names = (
        [package]
        if not hasattr(whole, "__path__")
        else [each.name for each in pkgutil.walk_packages(whole.__path__, f"{package}.")]
    )
    return [importlib.import_module(name) for name in names if not name.startswith(tuple(leave_out))]


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(isinstance(each, int | float) for each in value)
    return isinstance(value, int | float | np.ndarray | Noise)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_times(each, factor) for each in value)
    if isinstance(value, Noise):
        return Noise(**{name: number * factor for name, number in value.model_dump().items()})
    if isinstance(value, int):
        return max(round(value * factor), 1)
    if isinstance(value, float) and 0.5 < value < 1:
        return 1 - (1 - value) * factor
    return value * factor


def _set(module: ModuleType, name: str, value: Any) -> None:
    """Set a module's constant; functions that are compiled with it are compiled again, those that are called first."""
    setattr(module, name, value)
    compiled = [
        each for each in vars(module).values() if hasattr(each, "recompile") and each.__module__ == module.__name__
    ]
    for function in reversed(compiled):
        function.recompile()
