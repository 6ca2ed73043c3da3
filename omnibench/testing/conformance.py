"""Base class of all conformance cases, and a runner that works without pytest."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar
from unittest import SkipTest

import numpy as np
from pydantic import BaseModel

from omnibench.errors import OmnibenchError, PluginError
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import Options, Registry, load_plugin_file


class Nonconformance(AssertionError):  # noqa: N818 (reads as what it is in a test report)
    """A class violates its contract; the message says how, in one line."""


class Conformance:
    """Cases that a registered class must pass; each method ``test_*`` is one.

    name: registered name of the class. options: options of the instance under test.
    """

    registry: ClassVar[Registry[Any]]
    name: ClassVar[str]
    options: ClassVar[Mapping[str, Any]] = {}

    def make(self) -> Any:
        """A new instance of the class under test."""
        return self.registry.create(self.name, self.options)

    def test_class_and_options_are_documented(self) -> None:
        """``omnibench list`` and the JSON schema show these texts."""
        cls = type(self.make())
        require((cls.__doc__ or "").strip(), f"{cls.__name__} has no docstring; its first line is its summary")
        model: type[BaseModel] = getattr(cls, "Options", Options)
        bare = [name for name, field in model.model_fields.items() if not field.description]
        require(not bare, f"options without a description: {', '.join(bare)}; use Field(..., description=...)")


class CaseOutcome(StrEnum):
    """The end of a case."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"  # it does not apply; the message says why


@dataclass(frozen=True)
class CaseResult:
    """Result of one case on one registered class. case: in words. message: the violation, or why it was skipped."""

    kind: str
    name: str
    case: str
    outcome: CaseOutcome
    message: str = ""

    @property
    def passed(self) -> bool:
        """True unless the case failed."""
        return self.outcome is not CaseOutcome.FAILED


def run_cases(suite: Conformance, watch: Reporter = no_progress) -> list[CaseResult]:
    """Run every case of ``suite``, in the order of definition; an exception becomes the case's result.

    watch: told of each before it runs.
    """
    defined = [name for cls in reversed(type(suite).__mro__) for name in vars(cls) if name.startswith("test_")]
    results = []
    for method in dict.fromkeys(defined):
        case = method.removeprefix("test_").replace("_", " ")
        watch(Progress(f"{suite.registry.kind} {suite.name} is tested: {case}"))
        outcome, message = CaseOutcome.PASSED, ""
        try:
            getattr(suite, method)()
        except SkipTest as skipped:
            outcome, message = CaseOutcome.SKIPPED, str(skipped)
        except (Nonconformance, OmnibenchError) as error:
            outcome, message = CaseOutcome.FAILED, str(error)
        except (Exception, SystemExit) as error:  # a plug-in may raise anything
            outcome, message = CaseOutcome.FAILED, f"{type(error).__name__}: {error}"
        results.append(CaseResult(suite.registry.kind, suite.name, case, outcome, " ".join(message.split())))
    return results


def load_plugin(path: Path) -> None:
    """Load a plug-in file for a test. PluginError names the file and why it cannot be loaded."""
    if path.is_dir():
        raise PluginError(f"{path}: is a folder; name the plug-in's file in it")
    if not path.is_file():
        raise PluginError(f"{path}: no such file")
    failure = load_plugin_file(path)
    if failure is not None:
        raise PluginError(f"{failure.origin} cannot be loaded: {failure.error}")


def require(condition: object, message: str) -> None:
    """Nonconformance with ``message`` unless ``condition`` holds."""
    if not condition:
        raise Nonconformance(" ".join(message.split()))


@contextmanager
def global_random_state(seed: int) -> Iterator[None]:
    """Seed the global generators of ``random`` and NumPy within the block, and restore them after it."""
    before, numpy_before = random.getstate(), np.random.get_state()  # noqa: NPY002 (what a plug-in must not use)
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(before)
        np.random.set_state(numpy_before)  # noqa: NPY002


def global_random_fingerprint() -> str:
    """The state of the global generators of ``random`` and NumPy, as text."""
    return f"{random.getstate()!r} {[np.asarray(part).tobytes() for part in np.random.get_state()]!r}"  # noqa: NPY002
