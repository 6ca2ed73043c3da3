"""Everything that a config can name, as tables and as a JSON document."""

from __future__ import annotations

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.registry import REGISTRIES, Entry, PluginFailure
from omnibench.report.blocks import Column, Row, Table


def print_registries(console: Console) -> None:
    """Print a table for each kind: calibrators, costs, effects, importers."""
    for registry in REGISTRIES:
        entries = registry.entries()
        rows = tuple(Row.of(entry.name, entry.summary, entry.origin) for entry in entries)
        columns = tuple(Column(heading, numeric=False) for heading in ("name", "what", "from"))
        if entries:
            print_table(console, Table(f"{registry.kind}s", columns, rows))
        else:
            console.print(f"{registry.kind}s: none yet")


def registry_document(failures: list[PluginFailure]) -> dict[str, object]:
    """Everything that a config can name, with the JSON schema of its options, and the plug-ins that failed."""

    def row(entry: Entry[object]) -> dict[str, object]:
        options = entry.options.model_json_schema().get("properties", {})
        return {"name": entry.name, "summary": entry.summary, "from": entry.origin, "options": options}

    document: dict[str, object] = {
        f"{registry.kind}s": [row(entry) for entry in registry.entries()] for registry in REGISTRIES
    }
    return document | {"failures": [{"from": failure.origin, "error": failure.error} for failure in failures]}
