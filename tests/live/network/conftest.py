"""Keys, and routers that let in who has them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from routers import ACCESS, MEMBERS, RouterProcess, mutual, running
from sessions import free_port

from omnibench.live.network.keys import make_keys


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder, MEMBERS, users=True)
    make_keys(folder / "other", ["apr02"], router="apr02")
    return folder


@pytest.fixture
def fleet(keys: Path, tmp_path: Path) -> Iterator[RouterProcess]:
    """A router with mutual TLS and access rules."""
    with running(tmp_path / "router", mutual(keys)) as router:
        yield router


@pytest.fixture
def users(keys: Path, tmp_path: Path) -> Iterator[RouterProcess]:
    """A router with users and passwords and access rules."""
    address = f"tcp/127.0.0.1:{free_port()}"
    config = {"listen": address, "users_file": str(keys / "users.txt"), "access": ACCESS}
    with running(tmp_path / "router", config) as router:
        yield router
