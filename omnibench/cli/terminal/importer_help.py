"""The help of an importer: its options with types, units and defaults, from their pydantic models."""

from __future__ import annotations

import inspect
import re
import shutil
import textwrap
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from omnibench.registry import importers

_WIDEST = 100  # columns; longer lines are hard to read; chosen
_OTHERS = "Options"  # heading of options whose class names no group


def importer_help(name: str, command: str) -> str:
    """What ``import FORMAT --help`` prints. UnknownNameError: there is no importer of that name."""
    entry = importers.entry(name, "import")
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    lines = [f"Usage: {command} {name} SOURCE -o DATASET [--set KEY=VALUE ...]", ""]
    lines += [*_wrapped((inspect.getdoc(entry.cls) or "").replace("``", ""), width), ""]
    lines += _wrapped("Options, each set by --set KEY=VALUE, the value in YAML; a list is [a,b]:", width)
    schema = entry.options.model_json_schema(by_alias=True)
    for heading, fields in _groups(entry.options).items():
        lines += ["", f"{heading}:"]
        for key, field in fields.items():
            lines += _option(key, field, schema["properties"].get(key, {}), schema.get("$defs", {}), width)
    return "\n".join(lines)


def _wrapped(text: str, width: int) -> list[str]:
    """Paragraphs wrapped to a width; indented lines as they are, as far as they fit."""
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        rows = paragraph.split("\n")
        if lines:
            lines.append("")
        if rows[0].startswith("    "):
            for row in _entries(rows):
                hang = 4 + (len(row[4:]) - len(re.sub(r"^\S.*?  +", "", row[4:])))
                lines += textwrap.wrap(row, width, subsequent_indent=" " * min(hang, 24), drop_whitespace=True)
        else:
            lines += textwrap.wrap(" ".join(rows), width)
    return lines


def _entries(rows: list[str]) -> list[str]:
    """Indented rows, each with the more indented ones that go on with it."""
    entries: list[str] = []
    for row in rows:
        if entries and len(row) - len(row.lstrip()) > 4:
            entries[-1] = f"{entries[-1]} {row.strip()}"
        else:
            entries.append(row)
    return entries


def _groups(options: type[BaseModel]) -> dict[str, dict[str, FieldInfo]]:
    """The options by the group of the class that declares them, the importer's own first."""
    groups: dict[str, dict[str, FieldInfo]] = {}
    declared: set[str] = set()
    for cls in reversed(options.__mro__):
        for key in getattr(cls, "__annotations__", {}):
            if key in options.model_fields and key not in declared:
                declared.add(key)
                groups.setdefault(getattr(cls, "group", _OTHERS), {})[key] = options.model_fields[key]
    own = getattr(options, "group", _OTHERS)
    return dict(sorted(groups.items(), key=lambda pair: ("robot" not in pair[1], pair[0] != own)))


def _option(
    key: str, field: FieldInfo, schema: dict[str, Any], definitions: dict[str, Any], width: int
) -> Iterator[str]:
    """Key, type and default on a line, and what the option says below."""
    default = "   default: as its folder is called" if key == "name" else _default(field)
    kind = ", ".join(dict.fromkeys(_kinds(schema, definitions)))
    yield from textwrap.wrap(f"  {key}  {kind}{default}", width, subsequent_indent=" " * 6, break_on_hyphens=False)
    if field.description:
        yield from textwrap.wrap(
            field.description, width, initial_indent=" " * 6, subsequent_indent=" " * 6, break_on_hyphens=False
        )


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "   must be given"
    default = field.get_default(call_default_factory=True)
    if default is PydanticUndefined or default in (None, (), {}, "") or isinstance(default, BaseModel):
        return ""
    if isinstance(default, tuple | list):
        return f"   default [{','.join(map(str, default))}]"
    shown = f"{default:g}" if isinstance(default, float) else str(default)
    return f"   default {shown.lower() if isinstance(default, bool) else shown}"


def _kinds(schema: dict[str, Any], definitions: dict[str, Any]) -> Iterator[str]:
    """The types that an option takes, in words."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        yield "FILE.yaml" if name.startswith("Robot") else f"{name.lower()}: {{key: value}}"
    elif "anyOf" in schema:
        for each in schema["anyOf"]:
            yield from _kinds(each, definitions)
    elif "allOf" in schema:
        yield from _kinds(schema["allOf"][0], definitions)
    elif "enum" in schema:
        yield f"{', '.join(map(str, schema['enum'][:-1]))} or {schema['enum'][-1]}"
    elif "const" in schema:
        yield str(schema["const"])
    elif schema.get("type") == "array":
        items = schema.get("items") or (schema.get("prefixItems") or [{}])[0]
        inner = ", ".join(dict.fromkeys(_kinds(items, definitions))) or "values"
        yield f"{inner}, or a list"
    elif schema.get("type") == "object":
        yield "{key: value}"
    elif schema.get("type") in _NAMES:
        yield _NAMES[schema["type"]] + _bound(schema)


_NAMES = {"string": "text", "number": "number", "integer": "whole number", "boolean": "true or false"}


def _bound(schema: dict[str, Any]) -> str:
    if "exclusiveMinimum" in schema and "exclusiveMaximum" not in schema:
        return f" > {schema['exclusiveMinimum']:g}"
    return f" >= {schema['minimum']:g}" if "minimum" in schema else ""
