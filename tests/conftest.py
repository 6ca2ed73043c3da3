"""Fixtures that several rooms share."""

import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml

# Before numpy is loaded. On small matrices threads of BLAS only wait for each other when several tests run at once.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import real_recordings
import shared_results
from commands import Command, Prepared, commands_of_this_process, prepare, registries_restored
from hypothesis import settings

# The machine may be busy. What does not land shall be at fault itself, and not an example that this run alone drew:
# new ones are looked for with --hypothesis-profile explore.
settings.register_profile("omnibench", deadline=None, derandomize=True, max_examples=40)
settings.register_profile("explore", deadline=None, max_examples=500, print_blob=True)
settings.load_profile("omnibench")
yaml.SafeDumper.ignore_aliases = lambda *_: True  # in files that tests write: omnibench reads no aliases


def pytest_configure(config: pytest.Config) -> None:
    """Make the folder of results that all workers share, and let commands hear Ctrl-C.

    Workers inherit the folder's name, and commands what this process does with Ctrl-C, which it would ignore if the
    suite was started in the background.
    """
    # Commands, workers and jobs are hundreds of processes, each of which would compile all that it imports.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput"):
        os.environ[shared_results.FOLDER] = folder = tempfile.mkdtemp(prefix="omnibench-tests-")
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the studies first: their files take longest, and at the end the other workers would wait for them."""
    items.sort(key=lambda item: "study" not in item.path.parts)


@pytest.fixture(autouse=True)
def registries_as_before() -> Iterator[None]:
    """What a test registers or loads is gone after it."""
    with registries_restored():
        yield


@pytest.fixture(scope="module", autouse=True)
def registries_as_before_the_module() -> Iterator[None]:
    """What is registered or loaded for all tests of a module is gone after them."""
    with registries_restored():
        yield


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Commands, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return commands_of_this_process(capfd, monkeypatch)


@pytest.fixture
def loopback() -> Iterator[Any]:
    """A router on a free port of loopback, and clients of it."""
    from sessions import open_loopback  # which loads Zenoh

    opened = open_loopback()
    yield opened
    opened.close()


@pytest.fixture(scope="session")
def prepared() -> Prepared:
    """What commands need to work on: a config, a data set, a calibration. All tests share them: change a copy."""
    return prepare()


# Recordings of real robots, where they are at hand.
omni3 = pytest.fixture(scope="session")(real_recordings.omni3)
diff = pytest.fixture(scope="session")(real_recordings.diff)
tricyc = pytest.fixture(scope="session")(real_recordings.tricyc)
omni4 = pytest.fixture(scope="session")(real_recordings.omni4)
robotino = pytest.fixture(scope="session")(real_recordings.robotino)
