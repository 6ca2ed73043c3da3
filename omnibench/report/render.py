"""Rendering a document as one self-contained HTML file: no network, no fonts, no second file.

The plots are drawn by Plotly's bundle of Cartesian plots (templates/plotly, npm's plotly.js-cartesian-dist-min of the
version that plotly.py is made for), which is a third of the whole; a page holds it compressed.
"""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment as Templates
from jinja2 import PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape
from pydantic import BaseModel

from omnibench.config import to_yaml
from omnibench.environment import Environment, package_versions
from omnibench.files import write_text
from omnibench.report import blocks as page
from omnibench.report.blocks import Block, Document, FigureGrid, Section

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
    footer = f"omnibench {package_versions().get('omnibench', '')}, written {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    grids = [grid for _, grid in grids_of(document)]
    template = _templates().get_template("report.html.j2")
    return template.render(
        document=document, plot_options=_json(_PLOT_OPTIONS), footer=footer, library=_library() if grids else ""
    )


def fragment(blocks: Sequence[Block]) -> str:
    """The HTML of blocks without figures, for a notebook."""
    return _templates().get_template("fragment.html.j2").render(blocks=blocks)


def figures_page(grids: Mapping[str, FigureGrid]) -> str:
    """A page whose scripts draw grids of figures as pictures; figures.js says what it reads of each."""
    described = [
        {
            "name": name,
            "columns": grid.columns,
            "legend": [{"label": item.label, "colour": item.colour, "dash": item.dash} for item in grid.legend],
            "figures": [
                {"title": each.title, "height": each.height, **json.loads(each.plot.to_json())} for each in grid.figures
            ],
        }
        for name, grid in grids.items()
    ]
    return _templates().get_template("figures.html.j2").render(grids=described, library=_library() if grids else "")


def grids_of(document: Document) -> Iterator[tuple[tuple[str, ...], FigureGrid]]:
    """Every grid of figures, with the titles above it."""

    def of_blocks(blocks: Sequence[Block], titles: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], FigureGrid]]:
        for block in blocks:
            if isinstance(block, FigureGrid):
                yield titles, block
            elif isinstance(block, page.Details):
                yield from of_blocks(block.blocks, (*titles, block.title))
            elif isinstance(block, page.Choice):
                for title, inner in block.options.items():
                    yield from of_blocks(inner, (*titles, title))

    def of_sections(sections: Sequence[Section], titles: tuple[str, ...]) -> Iterator[Any]:
        for section in sections:
            yield from of_blocks(section.blocks, (*titles, section.title))
            yield from of_sections(section.sections, (*titles, section.title))

    return of_sections(document.sections, ())


@cache
def _library() -> str:
    """Plotly's Cartesian bundle, which draws these plots, compressed, in base64."""
    bundle = files("omnibench.report").joinpath("templates/plotly/plotly-cartesian.min.js.gz")
    return base64.b64encode(bundle.read_bytes()).decode()


@cache
def _templates() -> Templates:
    environment = Templates(
        loader=PackageLoader("omnibench.report"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    assert environment.loader is not None
    source = environment.loader.get_source
    # The name of an option is not broken at its dashes.
    option = r'<span class="option">\g<0></span>'
    environment.filters["prose"] = lambda words: Markup(re.sub(r"(?<!\S)--[a-z][a-z-]+", option, html.escape(words)))
    # Words may break after an underscore, too: long names must not widen a table beyond a phone or paper.
    environment.filters["breakable"] = lambda words: Markup(escape(words).replace("_", Markup("_<wbr>")))
    environment.filters["plot_json"] = lambda figure: _json(json.loads(figure.to_json()))
    environment.filters["script_json"] = _json
    environment.globals["source"] = lambda name: Markup(source(environment, name)[0])
    return environment


def _json(content: Any) -> Markup:
    """JSON that cannot end the script element that holds it."""
    dense = json.dumps(content, separators=(",", ":"), allow_nan=False)
    for character in "<>&":  # all else is ASCII already
        dense = dense.replace(character, f"\\u{ord(character):04x}")
    return Markup(dense)


def reproduction_section(config: BaseModel, settings: Sequence[page.Fact], environment: Environment) -> Section:
    """The section for an effective config, the settings that matter most, and the environment of the work."""
    facts = (
        *settings,
        page.Fact("Python", environment.python),
        page.Fact("Platform", environment.platform),
        page.Fact("Processor", environment.processor or "not known", f"{environment.processors} logical processors"),
        page.Fact("Versions", ", ".join(f"{name} {version}" for name, version in environment.versions.items())),
    )
    blocks = (
        page.Paragraph("The effective config lies beside this report. From this folder:"),
        page.Code("omnibench compare config.yaml -o again"),
        page.Facts(facts),
        page.Details("Effective config", (page.Code(to_yaml(config)),)),
    )
    return Section("reproduction", "How to reproduce", blocks, about="Config, versions and machine.", folded=True)
