"""The wheel samples of a run, which its Trajectory and its WheelLogs share by a handle.

The handle gives each array when it is asked for: one in memory, or what a function reads from a file. A class that
holds it has the arrays as attributes and takes them in its constructor; ``dataclasses.replace`` passes the handle on,
so that replacing anything else reads no samples.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import cached_property, partial, wraps
from typing import Any, Final, TypeVar

import numpy as np

from omnibench.robot.kinematics import Array, Drive, in_the_middle

T = TypeVar("T")

DIGITS = 8  # of the digest of samples: a run is taken for one of 1000 others in 1 of 4 million cases
_UNCHANGED: Final = object()  # stands for an array that ``replace`` leaves alone


class Samples:
    """Wheel samples of one run: arrays by their names in Trajectory, each an array, None or a function that reads it.

    size: number and end (s) of the samples, where they are known without reading.
    """

    def __init__(self, arrays: Mapping[str, Any], size: tuple[int, float] | None = None) -> None:
        self._arrays, self._size = dict(arrays), size
        self._signals: tuple[Drive, Array] | None = None

    def array(self, name: str) -> Any:
        """The array called ``name``: times (F,), rates (F, N), steering, angles, targets or odometry; or None."""
        value = self._arrays.get(name)
        return value() if callable(value) else value

    def has(self, name: str) -> bool:
        """True if there is an array called ``name``."""
        return self._arrays.get(name) is not None

    def contents(self) -> dict[str, Any]:
        """All arrays by their names, which are read where they stand in a file."""
        return {name: self.array(name) for name in sorted(self._arrays)}

    @property
    def held(self) -> bool:
        """True if all arrays are in memory."""
        return not any(map(callable, self._arrays.values()))

    @property
    def count(self) -> int:
        """Number of samples, F."""
        return self._size[0] if self._size else len(self.array("times"))

    @property
    def end(self) -> float:
        """End of the last sample, s."""
        return self._size[1] if self._size else float(self.array("times")[-1])

    @cached_property
    def period(self) -> float:
        """The median time between samples, the run's start being the first, s."""
        return float(np.median(np.diff(self.array("times"), prepend=0.0)))

    @cached_property
    def digest(self) -> str:
        """The first 8 hex digits of the SHA-256 of times, rates and steering angles."""
        arrays = [self.array(name) for name in ("times", "rates", "steering")]
        return digest_of(*(array for array in arrays if array is not None))[:DIGITS]

    def summarise(self) -> None:
        """Compute period and digest now, of samples that would have to be read again for it."""
        _ = self.held or (self.period, self.digest)

    def signals(self, drive: Drive | None) -> Array:
        """Drive signals (F, M), rad/s: the rates, or what ``drive`` makes of them and the steering angles."""
        rates: Array = self.array("rates")
        if drive is None or drive.direct:
            return rates
        if self._signals is None or self._signals[0] is not drive:
            signals = drive.signals(rates, in_the_middle(self.array("steering")))
            if not self.held:
                return signals
            self._signals = drive, signals
        return self._signals[1]

    def changed(self, arrays: Mapping[str, Any]) -> Samples:
        """These samples with other arrays in the place of some, by name."""
        return Samples(self._arrays | dict(arrays), None if "times" in arrays else self._size) if arrays else self

    def followed(self, row: Mapping[str, Any]) -> Samples:
        """These samples and one more, for which ``row`` has the values of some of the arrays."""
        arrays = {name: partial(_followed, self, name, value) for name, value in row.items()}
        longer = Samples(arrays, (self.count + 1, float(row["times"])))
        return longer.loaded() if self.held else longer

    def loaded(self) -> Samples:
        """These samples in memory."""
        return self if self.held else Samples({name: self.array(name) for name in self._arrays})


def _followed(samples: Samples, name: str, value: Any) -> Array:
    return np.concatenate([samples.array(name), np.array(value)[None]])


def digest_of(*contents: Any) -> str:
    """SHA-256, in hex digits, of arrays of numbers, or bytes, one after another."""
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content if isinstance(content, bytes) else np.ascontiguousarray(content, dtype=float).tobytes())
    return digest.hexdigest()


def with_samples(*names: str, **renamed: str) -> Callable[[type[T]], type[T]]:
    """Class decorator: a dataclass takes some fields as arrays and holds them by a handle in its field ``samples``.

    names: the fields, which are called in the handle as they are here. renamed: fields, with their names in the handle.
    ``dataclasses.fields`` lists ``samples`` in their place.
    """
    in_handle = {name: name for name in names} | renamed

    def decorate(cls: type[T]) -> type[T]:
        make: Callable[..., None] = cls.__init__
        for field, name in in_handle.items():
            setattr(cls, field, _Sampled(name))
            cls.__dataclass_fields__.pop(field)  # type: ignore[attr-defined]

        @wraps(make)
        def construct(self: Any, *arguments: Any, samples: Samples | None = None, **given: Any) -> None:
            unchanged = {} if samples is None else dict.fromkeys(in_handle, _UNCHANGED)
            make(self, *arguments, **(unchanged | given))
            arrays = vars(self).pop("_given", {})
            vars(self)["samples"] = Samples(arrays) if samples is None else samples.changed(arrays)

        cls.__init__ = construct  # type: ignore[method-assign]
        return cls

    return decorate


class _Sampled:
    """Attribute whose value is an array of the instance's samples."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, owner: type[Any]) -> Any:
        return self if instance is None else instance.samples.array(self._name)

    def __set__(self, instance: Any, value: Any) -> None:  # by the constructor alone: the classes are frozen
        if value is not _UNCHANGED:
            vars(instance).setdefault("_given", {})[self._name] = value
