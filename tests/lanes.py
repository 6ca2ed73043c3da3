"""Parameters of tests that are run in the slow lane alone."""

from typing import Any

import pytest


def slow(*values: Any) -> list[Any]:
    """The values as parameters that only ``pytest -m slow`` tries."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def slow_cases(*cases: tuple[Any, ...]) -> list[Any]:
    """The same of cases with several arguments."""
    return [pytest.param(*case, marks=pytest.mark.slow) for case in cases]
