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

from omnibench.registry import importers

_WIDEST = 100  # columns; longer lines are hard to read; chosen
_OTHERS = "Options"  # heading of options whose class names no group


def importer_help(name: str, command: str) -> str:
    """The text of ``import FORMAT --help``. UnknownNameError: there is no importer of that name."""
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
    """Paragraphs wrapped to a width; indented ones line by line, with what is indented more behind the line before."""
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        lines += [""] if lines else []
        if paragraph.startswith("    "):
            for row in re.sub(r"\n {5,}", " ", paragraph).split("\n"):
                head = re.match(r" {4}\S.*?  +", row)
                lines += textwrap.wrap(row, width, subsequent_indent=" " * min(len(head[0]) if head else 4, 24))
        else:
            lines += textwrap.wrap(" ".join(paragraph.split("\n")), width)
    return lines


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
    default = field.get_default(call_default_factory=True)
    shown = f"{default:g}" if isinstance(default, float) else str(default)
    if key == "name":
        ending = "   default: as its folder is called"
    elif field.is_required():
        ending = "   must be given"
    elif isinstance(default, tuple | list) and default:
        ending = f"   default [{','.join(map(str, default))}]"
    elif default in (None, "", (), [], {}) or isinstance(default, BaseModel):
        ending = ""
    else:
        ending = f"   default {shown.lower() if isinstance(default, bool) else shown}"
    indent, kind = " " * 6, ", ".join(dict.fromkeys(_kinds(schema, definitions)))
    yield from textwrap.wrap(f"  {key}  {kind}{ending}", width, subsequent_indent=indent, break_on_hyphens=False)
    said = textwrap.TextWrapper(width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
    yield from said.wrap(field.description or "")


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
        least = f" >= {schema['minimum']:g}" if "minimum" in schema else ""
        if "exclusiveMinimum" in schema and "exclusiveMaximum" not in schema:
            least = f" > {schema['exclusiveMinimum']:g}"
        yield _NAMES[schema["type"]] + least


_NAMES = {"string": "text", "number": "number", "integer": "whole number", "boolean": "true or false"}
