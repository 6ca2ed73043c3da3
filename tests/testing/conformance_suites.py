"""Conformance cases on classes that need not be registered."""

from __future__ import annotations

from typing import Any

from omnibench.testing import (
    Conformance,
    run_cases,
)


def suite(base: type[Conformance], cls: type, **attributes: Any) -> Conformance:
    """The cases of ``base`` on instances of ``cls``, which need not be registered for that."""
    return type("Suite", (base,), {"name": cls.__name__, "make": lambda _: cls(cls.Options()), **attributes})()


def failures(base: type[Conformance], cls: type, **attributes: Any) -> dict[str, str]:
    """The cases that instances of ``cls`` fail, and what is said of each."""
    return {result.case: result.message for result in run_cases(suite(base, cls, **attributes)) if not result.passed}
