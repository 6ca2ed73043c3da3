"""Parameters of tests that are run in the slow lane alone."""

from __future__ import annotations

from typing import Any

import pytest


def slow(*values: Any) -> list[Any]:
    """The values as parameters that only ``pytest -m slow`` tries."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]
