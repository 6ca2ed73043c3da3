"""The environment that results come from: versions of software, and hardware."""

from __future__ import annotations

import os
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from omnibench.config import Model

_PACKAGES = (
    *("omnibench", "numpy", "scipy", "nlopt", "cvxpy", "clarabel", "cma", "polars", "pydantic"),
    *("eclipse-zenoh", "filterpy", "rosbags"),
)


class Environment(Model):
    """Software and machine."""

    versions: dict[str, str]
    python: str
    platform: str
    processor: str
    processors: int


@cache
def package_versions() -> dict[str, str]:
    """Versions of the packages that results depend on; those that are installed."""
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def environment() -> Environment:
    """The machine and the software, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        processor = platform.processor() or platform.machine()
    else:
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
        processor = names[0] if names else platform.machine()
    return Environment(
        versions=package_versions(),
        python=platform.python_version(),
        platform=platform.platform(),
        processor=processor,
        processors=os.cpu_count() or 1,
    )
