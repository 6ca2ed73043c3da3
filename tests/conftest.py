"""Fixtures that several rooms share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import Command, Prepared, commands_of_this_process, prepare
from hypothesis import settings

from omnibench import registry

# The machine may be busy. What does not land shall be at fault itself, and not an example that this run alone drew:
# new ones are looked for with --hypothesis-profile explore.
settings.register_profile("omnibench", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, max_examples=1000, print_blob=True)
settings.load_profile("omnibench")


@pytest.fixture
def registries_as_before() -> Iterator[None]:
    """What a test registers or loads is gone after it."""
    for each in registry.REGISTRIES:
        each.entries()  # what is built in stays
    entries, loaded = [dict(each._entries) for each in registry.REGISTRIES], dict(registry._loaded)
    yield
    for each, kept in zip(registry.REGISTRIES, entries, strict=True):
        each._entries = kept
    registry._loaded.clear()
    registry._loaded.update(loaded)


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Commands, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return commands_of_this_process(capfd, monkeypatch)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """What commands need to work on: a config, a data set, a calibration."""
    return prepare(tmp_path_factory.mktemp("prepared"))
