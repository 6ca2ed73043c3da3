"""Results on disk by content: one file a key, so that work can be continued."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

from pydantic import BaseModel, TypeAdapter

from omnibench.files import remove, write_text

T = TypeVar("T")


def content_key(facts: Mapping[str, Any]) -> str:
    """The key (20 hexadecimal digits) of all that a result depends on: values, documents, dataclasses and arrays."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=_plain).encode()).hexdigest()[:20]


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return [value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()]  # an array


def code_digest(package: Path, files: Iterable[Path]) -> str:
    """Hash of code: paths of the files in ``package`` and their contents."""
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.relative_to(package).as_posix().encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


class Store(Protocol[T]):
    """Where results of jobs are kept, by key."""

    def anchored(self) -> Self:
        """The store, to be found by a job that changes its working folder, too."""

    def get(self, key: str) -> T | None:
        """The stored result; None where there is none."""

    def keep(self, key: str, result: T) -> Any:
        """Keep a result where it was made; what this returns, if anything, is then given to ``put_content`` at home."""

    def content(self, key: str, result: T) -> Any:
        """The result as ``put_content`` takes it from a machine that does not reach the store."""

    def put(self, key: str, result: T) -> None:
        """Store a result."""

    def put_content(self, key: str, content: Any) -> None:
        """Store a result that another process made the content of."""

    def file(self, key: str) -> Path:
        """Where the result stands, in words of a message."""


@dataclass(frozen=True)
class ResultStore(Generic[T]):
    """Results by key, each in a JSON file in ``folder``.

    kind: their class, a dataclass or a document whose fields pydantic can write and read (arrays: ``JsonArray``).
    """

    folder: Path
    kind: type[T]

    def anchored(self) -> Self:
        """The store by its folder's absolute path."""
        return replace(self, folder=self.folder.absolute())

    def get(self, key: str) -> T | None:
        """The stored result; None where there is none, or its file is damaged."""
        try:
            return _adapter(self).validate_json(self.file(key).read_bytes())
        except (OSError, ValueError):  # ValueError: pydantic's and Unicode's errors, too
            return None

    def put(self, key: str, result: T) -> None:
        """Store a result, whole or not at all. DataError when it cannot be written, ValueError for a wrong type."""
        self.put_content(key, self.content(key, result))

    def keep(self, key: str, result: T) -> None:
        """Store a result, as ``put``: a job whose file is there has done its work, whatever becomes of its parent."""
        self.put(key, result)

    def content(self, key: str, result: T) -> str:  # noqa: ARG002 (as ``put``)
        """What the result's file will hold. ValueError for a wrong type."""
        return json.dumps(_adapter(self).dump_python(result, mode="json", warnings="error"))

    def put_content(self, key: str, content: str) -> None:
        """Store a result that another process made the content of. DataError when it cannot be written."""
        write_text(self.file(key), content)

    def file(self, key: str) -> Path:
        """The result's file."""
        return self.folder / f"{key}.json"

    def remove(self) -> None:
        """Remove all results, half-written ones too, and the folder if it is then empty. DataError: disk refuses."""
        for file in (*self.folder.glob("*.json"), *self.folder.glob(".*.json.*.partial")):
            remove(file)
        with suppress(OSError):
            self.folder.rmdir()


@cache
def _adapter(store: ResultStore[T]) -> TypeAdapter[T]:
    return TypeAdapter(store.kind)
