"""Rendering a document as one self-contained HTML file: no network, no fonts, no second file.

One section of it says how to make a report's results again: command, settings, machine and config.

Words that not every reader knows are marked where a report first uses them, and explained below that section.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment as Templates
from jinja2 import PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs
from pydantic import BaseModel

from omnibench.config import to_yaml
from omnibench.environment import Environment, package_versions
from omnibench.files import write_text
from omnibench.report.blocks import Code, Details, Document, Fact, Facts, Paragraph, Section
from omnibench.words import plural

# The word as it is listed, the pattern that it is known by, and its meaning.
_WORDS: tuple[tuple[str, str, str], ...] = (
    ("held out", r"held[- ]out", "runs that the fit has not seen; a calibration is judged by them"),
    ("training", r"training", "the runs that the calibration is fitted to"),
    (
        "reference",
        r"references?|reference poses?",
        "the robot's poses as measured (motion capture, SLAM), taken as true",
    ),
    ("design values", r"design values", "radii and places of the wheels as drawn, before any calibration"),
    ("odometry", r"odometry", "the path that is computed from the wheels alone"),
    ("cost", r"costs?|CF", "what a calibration makes small: the mean error of the odometry, m and rad counted alike"),
    (
        "Eq. (6)",
        r"Eq\. \(6\)",
        "mean error of the final pose: position in m and heading in rad as one length",
    ),
    (
        "95 % interval",
        r"95 % intervals?",
        "holds the true value in 95 of 100 cases; from how much runs differ",
    ),
    ("bootstrap", r"bootstrap", "an interval from runs that are drawn again and again from those recorded"),
    ("Student's t", r"Student's t", "an interval from the spread of a few numbers"),
    ("entry", r"entry|entries", "a calibrator with its options, as the config lists it"),
    ("not told apart", r"not told apart", "chance could explain the difference"),
    ("seed", r"seeds?", "the start of the random numbers; another seed is another try"),
    ("box", r"box(?!\))", "the range that a search may take the matrix from"),
    ("matrix", r"matrix", "the numbers that turn wheel rates into the robot's motion (inverse kinematic matrix)"),
    ("command", r"(?<!follows its )commands?", "a motion that the robot is told to drive; its repetitions share it"),
    ("residual", r"residuals?", "reference minus odometry"),
    (
        "noise floor",
        r"(?<!free )(?<!on the )(?<!over the )(?<!patch of the )floor",
        "the error that repetitions of one command leave to any model",
    ),
    (
        "whitened χ²",
        r"whitened χ²",
        "squared residuals over their noise: about 1 for each where only noise is left",
    ),
    (
        "weight",
        r"weight(?= of (?:the name|\d)| [\d<])",
        "the probability that this name, and no other that was tried, is right",
    ),
    ("baseline", r"baseline", "the runs as they were recorded or planned, which the choice is compared with"),
    (
        "information",
        r"information(?= per)",
        "how well all elements of the matrix become known together; twice the runs give twice as much",
    ),
    ("D-optimum", r"D-optim(?:um|al)", "the runs that give the most information for their number"),
    ("Cramér-Rao bound", r"Cramér-Rao bound", "the smallest standard deviation that any fit can have"),
    ("bound", r"the bound(?= that no design)", "what no choice of commands can exceed"),
    ("covariance", r"covariances?", "how uncertain a pose is, and in which direction"),
    ("NEES", r"NEES", "squared error over the stated uncertainty; 3 where that is right"),
    ("SLAM", r"SLAM", "poses computed from laser scans"),
)
_MEANINGS: Mapping[str, str] = {word: meaning for word, _, meaning in _WORDS}
# A group a word, in their order, so that a pattern may look ahead of its match.
_ANY = re.compile("|".join(f"((?<![\\w-])(?:{pattern})(?![\\w-]))" for _, pattern, _ in _WORDS), re.IGNORECASE)


class Glossary:
    """The words of one report: those that were explained already, and those marked since they were last listed."""

    def __init__(self) -> None:
        self._known: set[str] = set()
        self._fresh: list[str] = []

    def marked(self, text: str) -> Markup:
        """A text as HTML, in which each word that occurs for the first time shows its meaning."""
        parts, end = [], 0
        for match in _ANY.finditer(text):
            word = _WORDS[(match.lastindex or 1) - 1][0]
            if word in self._known:
                continue
            self._known.add(word)
            self._fresh.append(word)
            title = html.escape(_MEANINGS[word])
            parts.append(_escaped(text[end : match.start()]))
            parts.append(f'<dfn title="{title}" tabindex="0">{html.escape(match.group())}</dfn>')
            end = match.end()
        return Markup("".join([*parts, _escaped(text[end:])]))

    def fresh(self) -> list[tuple[str, str]]:
        """The words marked since the last call, with their meanings."""
        words, self._fresh = self._fresh, []
        return [(word, _MEANINGS[word]) for word in words]


def _escaped(text: str) -> str:
    """A text as HTML, in which the name of an option is not broken at its dashes."""
    return re.sub(r"(?<!\S)--[a-z][a-z-]+", r'<span class="option">\g<0></span>', html.escape(text))


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


def _environment(glossary: Glossary) -> Templates:
    """Templates and what they call; a glossary serves one report."""
    environment = Templates(
        loader=PackageLoader("omnibench.report"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["explained"] = glossary.marked
    # Words may break after an underscore, too: long names must not widen a table beyond a phone or paper.
    environment.filters["breakable"] = lambda words: Markup(escape(words).replace("_", Markup("_<wbr>")))
    environment.globals["new_terms"] = glossary.fresh
    environment.filters["plot_json"] = lambda figure: _json(json.loads(figure.to_json()))
    environment.filters["script_json"] = _json
    environment.globals["plotly_js"] = Markup(get_plotlyjs())
    environment.globals["source"] = lambda name: Markup(_source(environment, name))
    return environment


def _source(environment: Templates, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _json(content: Any) -> Markup:
    """JSON that cannot end the script element that holds it."""
    dense = json.dumps(content, separators=(",", ":"), allow_nan=False)
    for character in "<>&":  # all else is ASCII already
        dense = dense.replace(character, f"\\u{ord(character):04x}")
    return Markup(dense)


def reproduction_section(config: BaseModel, settings: Sequence[Fact], environment: Environment) -> Section:
    """The section for an effective config, the settings that matter most, and the environment of the work."""
    facts = (
        *settings,
        Fact("Python", environment.python),
        Fact("Platform", environment.platform),
        Fact("Processor", environment.processor or "not known", plural(environment.processors, "logical processor")),
        Fact("Versions", ", ".join(f"{name} {version}" for name, version in environment.versions.items())),
    )
    return Section(
        "reproduction",
        "How to reproduce",
        (
            Paragraph("The effective config lies beside this report. From this folder:"),
            Code("omnibench compare config.yaml -o again"),
            Facts(facts),
            Details("Effective config", (Code(to_yaml(config)),)),
        ),
        about="Config, versions and machine.",
        folded=True,
    )
