"""Everything that a config can name, as tables and as a JSON document."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from omnibench.registry import REGISTRIES, Entry, PluginFailure


def print_registries(console: Console) -> None:
    """Print a table for each kind: calibrators, costs, effects, importers."""
    for registry in REGISTRIES:
        entries = registry.entries()
        table = Table(title=f"{registry.kind}s", title_justify="left", title_style="bold", expand=False)
        for heading in ("name", "what", "from"):
            table.add_column(heading, overflow="fold")
        for entry in entries:
            table.add_row(entry.name, entry.summary, entry.origin)
        console.print(table if entries else f"{registry.kind}s: none yet")


def registry_document(failures: list[PluginFailure]) -> dict[str, object]:
    """Everything that a config can name, with the JSON schema of its options, and the plug-ins that failed."""

    def row(entry: Entry[object]) -> dict[str, object]:
        options = entry.options.model_json_schema().get("properties", {})
        return {"name": entry.name, "summary": entry.summary, "from": entry.origin, "options": options}

    document: dict[str, object] = {
        f"{registry.kind}s": [row(entry) for entry in registry.entries()] for registry in REGISTRIES
    }
    return document | {"failures": [{"from": failure.origin, "error": failure.error} for failure in failures]}
