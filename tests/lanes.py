"""Parameters of tests that are run in the slow lane alone."""

from __future__ import annotations

from typing import Any

import pytest


def slow(*values: Any) -> list[Any]:
    """The values, tuples of them where a case has several, as parameters that only ``pytest -m slow`` tries."""
    cases = (value if isinstance(value, tuple) else (value,) for value in values)
    return [pytest.param(*case, marks=pytest.mark.slow) for case in cases]
