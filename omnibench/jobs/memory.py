"""Limits of a process's memory, and what the system tells of processes that it killed for lack of memory."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_MEGABYTE = 1_000_000  # bytes


@contextmanager
def limited_memory(megabytes: float | None) -> Iterator[None]:
    """Limit the process's private memory, beyond which allocations raise MemoryError; None: no limit.

    RLIMIT_DATA counts memory that can be written to (anonymous mappings, since Linux 4.7). RLIMIT_AS also counts
    address space that is only reserved: with 700 MB of it before a run begins, Numba and polars then cannot be loaded.
    """
    if megabytes is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = int(megabytes * _MEGABYTE)
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))  # there is room for reporting the error


def memory_limit() -> float | None:
    """The limit of this process's private memory in 10^6 bytes; None without one."""
    soft, _ = resource.getrlimit(resource.RLIMIT_DATA)
    return None if soft == resource.RLIM_INFINITY else soft / _MEGABYTE


def oom_kills() -> int:
    """Number of processes that the system has killed for lack of memory; 0 where it does not say (not Linux)."""
    try:
        counts = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in counts if line.startswith("oom_kill "))
