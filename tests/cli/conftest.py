"""Fixtures of the command line's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from sessions import Loopback, open_loopback


@pytest.fixture
def loopback() -> Iterator[Loopback]:
    """A router on a free port of loopback, and clients of it."""
    opened = open_loopback()
    yield opened
    opened.close()
