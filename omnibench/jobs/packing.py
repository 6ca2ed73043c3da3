"""Jobs as bytes for another machine: what many of them share is pickled once, and named by its content."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

from omnibench.jobs.job import Job
from omnibench.progress import Reporter
from omnibench.registry import import_copies


class Packer:
    """Pickles jobs. Objects that they share are kept, so that each is pickled once."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Any, str, bytes]] = {}

    def pack(self, job: Job[Any]) -> tuple[bytes, dict[str, bytes]]:
        """The job's function and argument without what it shares, and that by the hash of its content."""
        shared = {id(value): self._content(value) for value in job.shared}
        stream = BytesIO()
        _Pickler(stream, {key: name for key, (_, name, _) in shared.items()}).dump((job.function, job.argument))
        return stream.getvalue(), {name: content for _, name, content in shared.values()}

    def packed(self, job: Job[Any]) -> Job[Any]:
        """A job of our own code packed for a process of this machine, to which what jobs share goes once; any other."""
        if not (job.own and job.shared):
            return job
        content, shared = self.pack(job)
        return replace(job, function=run_packed, argument=PackedJob(content, shared, {}, kept=True), shared=())

    def _content(self, value: Any) -> tuple[Any, str, bytes]:
        if id(value) not in self._known:
            content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
            self._known[id(value)] = value, hashlib.sha256(content).hexdigest()[:20], content
        return self._known[id(value)]


class _Pickler(pickle.Pickler):
    """names: of the objects that are left out, by their ids."""

    def __init__(self, stream: BytesIO, names: Mapping[int, str]) -> None:
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)
        self._names = names

    def persistent_id(self, value: Any) -> str | None:
        return self._names.get(id(value))


class _Unpickler(pickle.Unpickler):
    """shared: the objects that were left out, by their names."""

    def __init__(self, content: bytes, shared: Mapping[str, Any]) -> None:
        super().__init__(BytesIO(content))
        self._shared = shared

    def persistent_load(self, name: str) -> Any:
        return self._shared[name]


@dataclass(frozen=True)
class PackedJob:
    """A job's function and argument as bytes. plugins: copies of plug-in files here, by their paths at home.

    kept: what the job shares with others, its ``names``, is kept in its process for the next job.
    """

    content: bytes
    shared: Mapping[str, bytes]
    plugins: Mapping[Path, Path]
    kept: bool = False
    names: tuple[str, ...] = ()

    def without(self, sent: Collection[str]) -> PackedJob:
        """The job for a process that has kept what was sent, by its names."""
        left = {name: value for name, value in self.shared.items() if name not in sent}
        return replace(self, shared=left, names=tuple(self.shared))


_KEPT: dict[str, Any] = {}  # objects that the last job of this process shared, by their names


def run_packed(packed: PackedJob, report: Reporter) -> Any:
    """Unpack a job in its process and run it."""
    import_copies(packed.plugins)
    shared = {name: pickle.loads(content) for name, content in packed.shared.items()}
    if packed.kept:
        shared |= {name: _KEPT[name] for name in packed.names if name not in shared}
        _KEPT.clear()
        _KEPT.update(shared)
    function, argument = _Unpickler(packed.content, shared).load()
    return function(argument, report)
