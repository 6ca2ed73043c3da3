"""The software that the results of jobs depend on, and where two machines differ in it."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points, version
from pathlib import Path

from omnibench.jobs.result_store import code_digest
from omnibench.registry import REGISTRIES

_PACKAGES = (
    *("numpy", "scipy", "cvxpy", "clarabel", "nlopt", "cma", "polars", "numba", "pydantic", "shapely"),
    *("dask", "distributed"),
)
_PACKAGE = Path(__file__).parents[1]


@cache
def software() -> dict[str, str]:
    """Versions of Python and of packages, omnibench's code by its hash, and installed packages of plug-ins."""
    points = {point for registry in REGISTRIES for point in entry_points(group=registry.group)}
    return {
        "Python": platform.python_version(),
        "omnibench's code": code_digest(_PACKAGE, _PACKAGE.rglob("*.py"))[:10],
        **{package: version(package) for package in _PACKAGES},
        **{point.dist.name: point.dist.version for point in points if point.dist is not None},
    }


def differences(there: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """What another machine has in the place of what is here, in words."""
    return [
        f"{name} {there.get(name, 'missing')} (here: {here.get(name, 'missing')})"
        for name in dict.fromkeys((*here, *there))
        if here.get(name) != there.get(name)
    ]
