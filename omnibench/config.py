"""Documents: YAML read into pydantic models, with errors of one line, and written as effective copies."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo
from pydantic_core import to_jsonable_python

from omnibench.errors import ConfigError, DataError, explain, shown
from omnibench.files import read_text
from omnibench.views import brief

M = TypeVar("M", bound=BaseModel)

LONGEST_NAME = 200  # characters of a name in a file, of which tables and messages show the whole; chosen

# Limits of a YAML document, far above what configs and calibrations need; chosen.
_MOST_BYTES: Final = 1 << 22  # bytes: a larger file is refused
MOST_VALUES: Final = 200_000
_DEEPEST: Final = 32  # levels of nesting
_LONGEST_NUMBER: Final = 400  # characters: what is longer is text, since long numbers take quadratic time

_PARSER: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the fast one in C if PyYAML has it
_FLOAT: Final = re.compile(
    r"^[-+]?(?:[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?|\.[0-9]+(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+"
    r"|\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
# A pattern of names on the command line, such as *_1 or [0-4]*, which has a meaning of its own in YAML, or none.
_NAME_PATTERN: Final = re.compile(r"\s*([*!&@%`]|\[[^\]]*\].)")

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Name = Annotated[str, Field(max_length=LONGEST_NAME)]


class Model(BaseModel):
    """Base of every document that omnibench reads: unknown keys are refused, instances are immutable.

    ConfigError in one line: an argument is missing, unknown or wrong.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    def __init__(self, **fields: Any) -> None:
        try:
            super().__init__(**fields)
        except ValidationError as error:
            raise ConfigError(f"{type(self).__name__}: {explain(error, type(self))}") from None

    # As of BaseModel.__init__: pydantic then makes the models within a document itself, and collects their mistakes.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def __repr__(self) -> str:
        return brief(type(self).__name__, self.__repr_args__())

    def __str__(self) -> str:
        return repr(self)


def printable(text: str) -> str:
    """The text. ValueError: it holds characters that no terminal shows."""
    if not text.isprintable():
        raise ValueError("contains characters that cannot be printed, such as tabs or no-break spaces")
    return text


def folder_of(info: ValidationInfo) -> Path | None:
    """The folder of the file that is being read as a model; None for a document from elsewhere."""
    folder: Path | None = (info.context or {}).get("folder")
    return folder


def _from_folder(path: Path, info: ValidationInfo) -> Path:
    folder = folder_of(info)
    return path if folder is None else Path(os.path.abspath(folder / path))  # links stay: they may change


# A path in a document, relative to the document's file; absolute once the file is read.
RelativePath = Annotated[Path, AfterValidator(_from_folder)]


class _Scalars(yaml.SafeLoader):
    """YAML 1.1's values of plain scalars, of which ``1e-6`` is a number, too."""

    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:float"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def value(self, event: yaml.ScalarEvent) -> Any:
        """The value of a scalar. ValueError: an impossible date, or text that is not Unicode (lone surrogates)."""
        text: str = event.value
        text.encode()
        plain = event.implicit[0] and len(text) <= _LONGEST_NUMBER
        tag: str = self.resolve(yaml.ScalarNode, text, (True, False)) if plain else ""  # type: ignore[no-untyped-call]
        construct = self.yaml_constructors.get(tag)
        return text if construct is None else construct(self, yaml.ScalarNode(tag, text))


_Scalars.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))


class _Dumper(yaml.SafeDumper):
    """Quotes what the loader would otherwise take for a number."""

    yaml_implicit_resolvers = _Scalars.yaml_implicit_resolvers


class _Document:
    """Reader of a YAML text that makes values of the parser's events, without aliases, tags and directives.

    most: values that it may have. YAMLError names the line of what is not read, such as a key that is there twice.
    """

    def __init__(self, text: str, most: int) -> None:
        self._events: Iterator[Any] = yaml.parse(text, Loader=_PARSER)
        self._most = most
        self._values = 0
        self._scalars = _Scalars("")

    def content(self) -> Any:
        """The values of the text's only document; None if it is empty."""
        next(self._events)  # the stream's start
        start: Any = next(self._events)
        if isinstance(start, yaml.StreamEndEvent):
            return None
        if start.version or start.tags:
            raise yaml.YAMLError("directives such as %YAML are not read; leave these lines out")
        content = self._node(next(self._events), 1)
        next(self._events)  # the document's end
        if not isinstance(rest := next(self._events), yaml.StreamEndEvent):
            raise yaml.YAMLError(f"{_line(rest)}: a second document begins; keep one")
        return content

    def _node(self, event: Any, depth: int) -> Any:
        self._values += 1
        if self._values > self._most:
            raise yaml.YAMLError(f"more than {self._most} values")
        if depth > _DEEPEST:
            raise yaml.YAMLError(f"{_line(event)}: nested too deeply")
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError(f"{_line(event)}: aliases are not read; write out what *{event.anchor} stands for")
        if event.tag is not None:
            raise yaml.YAMLError(f"{_line(event)}: tags such as !!str are not read; leave it out")
        if isinstance(event, yaml.ScalarEvent):
            return self._scalars.value(event)
        if isinstance(event, yaml.SequenceStartEvent):
            items = []
            while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
                items.append(self._node(event, depth + 1))
            return items
        mapping: dict[Any, Any] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key = self._node(event, depth + 1)
            if isinstance(key, list | dict):
                raise yaml.YAMLError(f"{_line(event)}: a key is a {type(key).__name__}, expected a word")
            if key == "<<" and event.implicit[0]:
                raise yaml.YAMLError(f"{_line(event)}: merge keys (<<) are not read; write the keys out")
            if key in mapping:
                raise yaml.YAMLError(f"{_line(event)}: key {shown(key)} is given twice")
            mapping[key] = self._node(next(self._events), depth + 1)
        return mapping


def _line(event: Any) -> str:
    return f"line {event.start_mark.line + 1}"


def read_yaml(path: Path) -> Any:
    """The content of a YAML file; ConfigError in one line when it cannot be read."""
    try:
        return parse_yaml(read_text(path, _MOST_BYTES), str(path))
    except DataError as error:
        raise ConfigError(str(error)) from None


def parse_yaml(text: str, where: str, most: int = MOST_VALUES) -> Any:
    """The content of YAML text; ConfigError in one line, with ``where`` in front, when it is not valid.

    most: values that it may have. Aliases, merge keys, tags and directives are refused: they make a text mean more than
    it shows.
    """
    try:
        return _Document(text, most).content()
    except (yaml.YAMLError, ValueError) as error:  # ValueError: an impossible date or number such as 2023-99-99
        mark = getattr(error, "problem_mark", None)
        problem = error if mark is None else f"line {mark.line + 1}: {getattr(error, 'problem', error)}"
        raise ConfigError(f"{where}: not valid YAML: {problem}") from None


def parse_settings(settings: Iterable[str] | None) -> dict[str, Any]:
    """``KEY=VALUE`` pairs of a command line, values in YAML; mappings that are given twice are joined.

    ConfigError names the pair.
    """
    options: dict[str, Any] = {}
    for setting in settings or ():
        key, equals, text = setting.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {setting}: expected KEY=VALUE")
        try:
            value = text if _NAME_PATTERN.match(text) else parse_yaml(text, f"--set {setting}")
        except ConfigError as error:
            quotes = "; put names that hold any of [ ] { } , : # in quotes, as {t: 'time [s]'}"
            raise ConfigError(f"{error}{quotes if text.startswith('{') else ''}") from None
        before = options.get(key)
        options[key] = {**before, **value} if isinstance(before, dict) and isinstance(value, dict) else value
    return options


def read_model(model: type[M], path: Path) -> M:
    """A YAML file as ``model``; ConfigError names file, key and the nearest known key."""
    return validate(model, read_yaml(path), str(path), path.resolve().parent)


def validate(model: type[M], data: Any, where: str, folder: Path | None = None) -> M:
    """``data`` as ``model``; ConfigError with ``where`` in front names the first fault.

    folder: from which relative paths start; default: they stay relative.
    """
    empty = data is None
    if empty:
        data = {}
    if not isinstance(data, Mapping | BaseModel):
        raise ConfigError(f"{where}: expected keys and values, found {type(data).__name__}")
    try:
        return model.model_validate(data, context={"folder": folder})
    except ValidationError as error:
        raise ConfigError(f"{where}: {'is empty: ' if empty else ''}{explain(error, model)}") from None


def to_yaml(document: BaseModel | Mapping[str, Any]) -> str:
    """A document as YAML that ``read_model`` reads back to the same values, floats to the last bit."""
    data = document.model_dump(mode="json", by_alias=True) if isinstance(document, BaseModel) else dict(document)
    # A JSON round trip drops types that YAML would tag (tuples, NumPy numbers).
    plain = json.loads(json.dumps(data))
    return yaml.dump(plain, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)


def to_json(document: BaseModel | Mapping[str, Any]) -> str:
    """A document as strict JSON; infinity and NaN, which JSON does not have, become null."""
    return json.dumps(to_jsonable_python(document, inf_nan_mode="null"), indent=1)


def as_yaml(value: Any) -> str:
    """A value as ``--set`` takes it."""
    if isinstance(value, str):
        plain = value and all(letter.isalnum() or letter in "._/*-" for letter in value) and value[0] != "*"
        return value if plain and parse_yaml(value, "value") == value else json.dumps(value)
    if isinstance(value, list | tuple):
        return f"[{','.join(as_yaml(item) for item in value)}]"
    if isinstance(value, bool | Mapping | None):
        return json.dumps(value)
    return str(int(value) if isinstance(value, float) and value.is_integer() else value)
