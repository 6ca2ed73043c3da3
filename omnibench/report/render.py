"""Rendering a document as one self-contained HTML file: no network, no fonts, no second file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from omnibench.environment import package_versions
from omnibench.files import write_text
from omnibench.report.blocks import Document
from omnibench.report.glossary import Glossary

_PLOT_OPTIONS = {
    "responsive": True,
    "displaylogo": False,
    "showSendToCloud": False,  # a report sends nothing anywhere
    "plotlyServerURL": "",
    "modeBarButtonsToRemove": ["select2d", "lasso2d"],
    "toImageButtonOptions": {"format": "svg"},
}


def write_document(document: Document, path: Path) -> None:
    """Write a report as one HTML file, complete or not at all. DataError: the disk refuses it."""
    write_text(path, render(document))


def render(document: Document) -> str:
    """The HTML of a report, with the version of omnibench and the time in its footer."""
    template = _environment(Glossary()).get_template("report.html.j2")
    footer = f"omnibench {package_versions().get('omnibench', '')}, written {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    return template.render(document=document, plot_options=_json(_PLOT_OPTIONS), footer=footer)


def figures_page(grids: Sequence[Mapping[str, Any]]) -> str:
    """A page whose scripts draw grids of figures as pictures; figures.js says what it reads of each."""
    return _environment(Glossary()).get_template("figures.html.j2").render(grids=grids)


def _environment(glossary: Glossary) -> Environment:
    """Templates and what they call; a glossary serves one report."""
    environment = Environment(
        loader=PackageLoader("omnibench.report"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["explained"] = glossary.marked
    environment.filters["breakable"] = _breakable
    environment.globals["new_terms"] = glossary.fresh
    environment.filters["plot_json"] = _plot_json
    environment.filters["script_json"] = _json
    environment.globals["plotly_js"] = Markup(get_plotlyjs())
    environment.globals["source"] = lambda name: Markup(_source(environment, name))
    return environment


def _breakable(words: str) -> Markup:
    """Words that may break after an underscore, too: long names must not widen a table beyond a phone or paper."""
    return Markup(escape(words).replace("_", Markup("_<wbr>")))


def _source(environment: Environment, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _plot_json(figure: go.Figure) -> Markup:
    return _json(json.loads(figure.to_json()))


def _json(content: Any) -> Markup:
    """JSON that cannot end the script element that holds it."""
    dense = json.dumps(content, separators=(",", ":"), allow_nan=False)
    for character in "<>&":  # all else is ASCII already
        dense = dense.replace(character, f"\\u{ord(character):04x}")
    return Markup(dense)
