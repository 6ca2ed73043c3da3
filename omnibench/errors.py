"""The family of errors that a user can cause, and ``explain``, which makes the one line of any error."""

from __future__ import annotations

import math
import re
import reprlib
import unicodedata
from collections.abc import Callable, Iterable, Sequence, Sized
from difflib import get_close_matches
from errno import EACCES, EDQUOT, EEXIST, EFBIG, EIO, EISDIR, ENOSPC, ENOTDIR, EPERM
from functools import wraps
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, get_args

from omnibench.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from pydantic import BaseModel, ValidationError
    from pydantic_core import ErrorDetails

P = ParamSpec("P")
R = TypeVar("R")

CHOSEN = "@"  # begins a union member's tag in a pydantic location: the class's name follows, which is no key

_HOLDERS = ("calibration", "config", "dataset", "robot")  # attributes of results in which another argument lies
_DIRECTIONS = "\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # marks of writing directions
_CONTROLS = ("Cc", "Cs", "Zl", "Zp")  # categories of Unicode that control a terminal, or that no file can hold
_LINEAR_ALGEBRA = ("numpy.linalg", "numpy.linalg.linalg", "_flapack")  # modules of the errors of numpy and LAPACK
_LONGEST = 2000  # characters of a message; a plug-in's may have millions (chosen: a screen of a terminal)
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 2, 60, 61  # 61: too long, shown by its type


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
    controls = {
        letter for letter in set(text) - {"\n"} if letter in _DIRECTIONS or unicodedata.category(letter) in _CONTROLS
    }
    return "".join("?" if letter in controls else letter for letter in text)


def shown(value: object) -> str:
    """A refused value in a message, in bounded time and length; of a long list or mapping its type and size."""
    if isinstance(value, int) and value.bit_length() > 200:
        return "a whole number of more than 60 digits"
    words = _SHORT.repr(value)
    if len(words) > 60:
        words = f"{type(value).__name__} of {len(value):,}" if isinstance(value, Sized) else type(value).__name__
    return words


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


def require_choice(what: str, value: object, words: Iterable[str], where: str = "") -> None:
    """UnknownNameError: an argument is none of the words that it may be."""
    known = tuple(words)
    if not isinstance(value, str) or value not in known:
        raise UnknownNameError(what, str(value), known, where)


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


def explain(error: BaseException, model: type[BaseModel] | None = None) -> str | None:
    """The one line for an error that the user can mend; None for a defect of the program.

    model: the document that pydantic refused (ValidationError), whose known keys the line then names.
    """
    if isinstance(error, OmnibenchError):
        return str(error)
    if (format_message := getattr(error, "format_message", None)) is not None:  # the command line refuses an option
        if type(error).__name__ == "NoArgsIsHelpError":
            return str(format_message())
        context = getattr(error, "ctx", None)
        message = " ".join(format_message().split()).replace("Value error, ", "")
        return f"{message} (see {context.command_path if context else 'omnibench'} --help)"
    if isinstance(error, MemoryError):
        return "out of memory; make the data or the budget smaller"
    if isinstance(error, UnicodeEncodeError):  # a file's name, as typed or as found in a folder
        return f"{error.object[:200]}: this name is not in UTF-8; rename the file or folder"
    if isinstance(error, OSError):  # a disk or a terminal that failed unexpectedly
        return f"{error.filename or 'output'}: {error.strerror or error}"
    from pydantic import ValidationError  # the command line's help does without it

    return _explain_mistakes(error, model) if isinstance(error, ValidationError) else not_computable(error)


def not_written(path: Path, error: OSError) -> DataError:
    """The error for a file or a folder that the system does not let be written, with what to do about it."""
    if error.errno == EISDIR:
        return DataError(f"{path}: cannot be written: is a folder; name a file")
    if error.errno in (EEXIST, ENOTDIR):
        return DataError(f"{path}: cannot be written: {path.parent} is not a folder; choose another place")
    way_out = "choose another place"
    if error.errno in (ENOSPC, EDQUOT, EFBIG, EIO):  # polars reports a full disk as an error of input or output
        way_out = f"free space or {way_out}"
    elif error.errno in (EACCES, EPERM):
        way_out = f"get permission to write there or {way_out}"
    return DataError(f"{path}: cannot be written: {error.strerror or error}; {way_out}")


def _explain_mistakes(error: ValidationError, model: type[BaseModel] | None) -> str:
    """The first mistake of a document, and how many more there are."""
    mistakes = error.errors(include_url=False)
    mistakes.sort(key=lambda mistake: mistake["type"] != "extra_forbidden")  # an unknown key explains a missing one
    first, said = mistakes[0], 1
    key = _key(first)
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        known = _known_keys(model, first["loc"][:-1])
        message = f"unknown key {key!r}; {nearest(str(first['loc'][-1]), known)}known: {', '.join(known) or 'none'}"
    elif first["type"] == "missing":
        keys = [repr(_key(mistake)) for mistake in mistakes if mistake["type"] == "missing"]
        said = len(keys)
        field = None if model is None else model.model_fields.get(key)
        meaning = f" ({field.description})" if field is not None and field.description else ""
        several = f"keys {', '.join(keys[:-1])} and {keys[-1]} are missing"
        message = several if len(keys) > 1 else f"key {key!r} is missing{meaning}"
    else:
        if first["type"] != "value_error":
            message += f" (given: {shown(first['input'])})"
        if first["type"] == "literal_error" and isinstance(first["input"], str):
            hint = nearest(first["input"], re.findall(r"'([^']*)'", first["ctx"]["expected"]))
            message += f"; {hint.strip()}" if hint else ""
        message = f"{key}: {message}" if key else message
    more = len(mistakes) - said
    return f"{message} (and {plural(more, 'more mistake')})" if more else message


def _key(mistake: ErrorDetails) -> str:
    """The place of a mistake, from the document's top: ``datasets.flower.simulate``."""
    return ".".join(str(part) for part in mistake["loc"] if not str(part).startswith(CHOSEN))


def _known_keys(model: type[BaseModel] | None, location: Sequence[int | str]) -> list[str]:
    """The keys of the documents that may stand at a place: classes in the annotations of the fields on the way there.

    Indexes, keys of mappings and names of union members are no fields, and are skipped.
    """
    models = [] if model is None else [model]
    for part in location:
        if str(part).startswith(CHOSEN):
            models = [member for member in models if member.__name__ == str(part).removeprefix(CHOSEN)]
            continue
        inner = [
            member
            for outer in models
            for name, field in outer.model_fields.items()
            if part in (name, field.alias)
            for member in _models_in(field.annotation)
        ]
        models = inner or models
    return sorted({key for member in models for key in member.model_json_schema().get("properties", {})})


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """The pydantic classes within an annotation, such as both of ``tuple[Wheel, ...] | Robot``."""
    if isinstance(annotation, type) and hasattr(annotation, "model_fields"):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]


def not_computable(error: BaseException) -> str | None:
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
