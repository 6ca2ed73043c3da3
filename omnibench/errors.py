"""The family of errors that a user can cause: the command line prints each as one line and exits with its code."""

from __future__ import annotations

import math
import reprlib
import unicodedata
from collections.abc import Callable, Iterable, Sized
from difflib import get_close_matches
from functools import wraps
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_HOLDERS = ("calibration", "config", "dataset", "robot")  # attributes of results in which another argument lies
_DIRECTIONS = "\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # marks of writing directions
_LINEAR_ALGEBRA = ("numpy.linalg", "numpy.linalg.linalg", "_flapack")  # modules of the errors of numpy and LAPACK
_LONGEST = 2000  # characters of a message; a plug-in's may have millions (chosen: a screen of a terminal)


def one_line(text: str) -> str:
    """A text as one line of printable characters, which any terminal and any file can hold; a long one is cut."""
    line = " ".join(text.split())
    if len(line) > _LONGEST:
        line = f"{line[:_LONGEST]} ... ({len(line) - _LONGEST:,} more characters)"
    return visible(line)


def visible(text: str) -> str:
    """A text with ? for each control character that is no line break: those of terminals, and of writing directions."""
    if text.isprintable():
        return text
    return "".join("?" if _controls(letter) and letter != "\n" else letter for letter in text)


def _controls(letter: str) -> bool:
    return unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") or letter in _DIRECTIONS


_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 2, 60, 61  # 61: too long, shown by its type


def shown(value: object) -> str:
    """A refused value in a message, in bounded time and length; of a long list or mapping its type and size."""
    if isinstance(value, int) and value.bit_length() > 200:
        return "a whole number of more than 60 digits"
    words = _SHORT.repr(value)
    if len(words) <= 60:
        return words
    return f"{type(value).__name__} of {len(value):,}" if isinstance(value, Sized) else type(value).__name__


class OmnibenchError(Exception):
    """A mistake that the user can correct. The message is one line: what, where, and what to do.

    exit_code: of the command line; 2, or 1 where the command was right and its work failed.
    """

    exit_code = 2

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class ConfigError(OmnibenchError):
    """A config, an option or an argument is wrong."""


class DataError(OmnibenchError):
    """A recording, a data set or a calibration file is wrong."""


class PluginError(OmnibenchError):
    """A plug-in cannot be loaded or does not keep the contract."""


class NotApplicableError(OmnibenchError):
    """A method is not for this robot, or not for such paths; the message says what it is for."""


class Interrupted(OmnibenchError):  # noqa: N818 (the user's wish, not a mistake)
    """Ctrl-C; the message says what is kept and how to go on."""


def require_type(value: object, kind: type, maker: str) -> None:
    """ConfigError: an argument is not of its type, as a path is not what ``maker`` makes of it."""
    if isinstance(value, kind):
        return
    held = [name for name in _HOLDERS if isinstance(getattr(value, name, None), kind)]
    way = f"take its .{held[0]}" if held else f"make one with omnibench.{maker}"
    raise ConfigError(f"expected a {kind.__name__}, found {shown(value)}; {way}")


def require_choice(what: str, value: object, words: Iterable[str]) -> None:
    """UnknownNameError: an argument is none of the words that it may be."""
    known = tuple(words)
    if not isinstance(value, str) or value not in known:
        raise UnknownNameError(what, str(value), known)


def require_range(what: str, value: Any, least: float, most: float = math.inf, *, whole: bool = False) -> None:
    """ConfigError: an argument is no number, or no whole number, from least to most."""
    right_kind = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
    if not right_kind or not least <= value <= most:
        number = "a whole number, " if whole else ""
        bounds = f"at least {least:g}" if math.isinf(most) else f"from {least:g} to {most:g}"
        raise ConfigError(f"{what}: must be {number}{bounds} (given: {shown(value)})")


class UnknownNameError(ConfigError):
    """A name that nothing is registered under."""

    def __init__(self, kind: str, name: str, known: Iterable[str], where: str = "") -> None:
        names = sorted(known)
        place = f"{where}: " if where else ""
        super().__init__(f"{place}unknown {kind} {name!r}; {nearest(name, names)}known: {', '.join(names) or 'none'}")


def nearest(name: str, known: Iterable[str]) -> str:
    """``did you mean 'x'? `` for the known name closest to ``name``, or an empty text where none is like it."""
    name, names = str(name), list(known)
    alike = get_close_matches(name, names, cutoff=0.5)  # short names with one letter wrong, and chance
    matches = get_close_matches(name, names, n=1) or [known_name for known_name in alike if known_name[0] == name[0]]
    return f"did you mean {matches[0]!r}? " if matches else ""


def not_computable(error: Exception) -> str | None:
    """The message for an error of linear algebra, as for data that are not finite; None for any other error."""
    if type(error).__module__ not in _LINEAR_ALGEBRA and "infs or NaNs" not in str(error):
        return None
    return f"the equations have no finite solution; omnibench check DATASET says what may be wrong with it ({error})"


def computable(function: Callable[P, R]) -> Callable[P, R]:
    """A function that raises DataError in one line where linear algebra fails."""

    @wraps(function)
    def call(*args: P.args, **options: P.kwargs) -> R:
        try:
            return function(*args, **options)
        except Exception as error:
            if (reason := not_computable(error)) is None:
                raise
            raise DataError(reason) from error

    return call
