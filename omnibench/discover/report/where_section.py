"""The section on where the plain model fails: covariates that the residuals depend on, and their figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from omnibench.discover.report import floor_figures, motion_figures, time_figures
from omnibench.discover.report.before_after import ALONE, EXTENDED, PLAIN, ModelStyle
from omnibench.discover.report.command_figures import command_blocks
from omnibench.discover.report.motor_figures import motor_grid
from omnibench.discover.report.residuals import Residuals
from omnibench.discover.report.tables import dependence_table
from omnibench.discover.result import Discovery
from omnibench.report.blocks import Block, Details, Paragraph, Section
from omnibench.report.numbers import listing

_FIGURES = {**time_figures.FIGURES, **motion_figures.FIGURES, **floor_figures.FIGURES}
_HOW = (
    "In the pictures over a covariate a point is the error of the motion that, constant in its bin, explains the "
    "residuals best together with those of the other bins (generalised least squares under the noise model); what the "
    "matrix could take up of it is gone already. The bands, in the colour of each model, hold 95 % of what comes out "
    "by chance: of noise, or of the same residuals with random signs for whole commands or runs, so that what depends "
    "on something else does not stand out."
)
_OVER = {"elapsed time": "the time of a run", "place": "the floor", "order of runs": "the order of the runs"}
# Why a covariate has no figure, in the order in which covariates are shown.
_NOT_DRAWN = {
    "elapsed time": "no run has a pose after its start",
    "heading": "the robot keeps its heading and its direction",
    "place": "the robot stays in its place",
    "order of runs": "when the runs were driven was not recorded",
    "wheel rate": "the wheels hardly change their rates",
    "wheel angle": "the wheels' absolute angles were not recorded",
    "acceleration": "hardly any run accelerates",
    "stamps": "nothing moves",
    "motors": "targets of the wheel rates were not recorded, or are copies of the rates",
}


def where_section(discovery: Discovery) -> Section:
    """The section on where: residuals by command, then over each covariate, the significant ones first."""
    residuals = Residuals(discovery)
    styles = _styles(discovery)
    motors = motor_grid(discovery, residuals.runs)
    drawn: dict[str, tuple[Block, ...]] = {
        covariate: tuple(grid for figure in _FIGURES[covariate] if (grid := figure(residuals, styles)) is not None)
        for covariate in _in_order(_FIGURES)
    }
    drawn["motors"] = () if motors is None else (motors,)
    covariates = [
        "motors" if dependence.stage == "actuator" else dependence.covariate for dependence in discovery.where
    ]
    named = [name for name in dict.fromkeys(covariates) if name in drawn]
    sections = [Section("where-command", "Residuals by command", command_blocks(residuals, styles))]
    for number, name in enumerate(named, 1):
        if drawn[name]:
            sections.append(Section(f"where-{number}", _title(name), drawn[name]))
    others: list[Block] = [
        Details(_title(name), blocks) for name, blocks in drawn.items() if name not in named and blocks
    ]
    not_drawn = [f"{name} ({_NOT_DRAWN.get(name, 'not recorded')})" for name, blocks in drawn.items() if not blocks]
    if not_drawn:
        others.append(Paragraph(f"Not drawn: {'; '.join(not_drawn)}.", "note"))
    if others:
        title = "Residuals over other covariates" if named else "Residuals over all covariates"
        sections.append(Section("where-others", title, tuple(others)))
    return Section("where", "Where", (*_dependences(discovery), Paragraph(_HOW, "note")), tuple(sections))


def _in_order(covariates: Iterable[str]) -> list[str]:
    """The covariates in the order of the report; new ones last."""
    order = list(_NOT_DRAWN)
    return sorted(covariates, key=lambda name: order.index(name) if name in order else len(order))


def _title(name: str) -> str:
    return (
        "Measured wheel rates against their targets" if name == "motors" else f"Residuals over {_OVER.get(name, name)}"
    )


def _dependences(discovery: Discovery) -> Iterator[Block]:
    if not discovery.where:
        yield Paragraph(
            "The residuals of the plain matrix depend on nothing that was tried by more than noise explains."
        )
        return
    words = listing(
        list(dict.fromkeys(dependence.covariate for dependence in discovery.where if dependence.stage != "actuator")), 9
    )
    if words:
        yield Paragraph(
            f"The residuals of the plain matrix depend on {words}. What makes them may show in several of these; the "
            "first stands out most."
        )
    if any(dependence.stage == "actuator" for dependence in discovery.where):
        yield Paragraph(
            "The wheels do not follow the targets of their motors. Odometry measures the wheels themselves and is not "
            "worse for it; a simulation from targets is."
        )
    yield dependence_table(discovery.where, "Where the plain matrix fails")


def _styles(discovery: Discovery) -> tuple[ModelStyle, ...]:
    """The styles of both models, or of the plain one alone if nothing was added."""
    pairs = zip(discovery.before, discovery.after, strict=True)
    return (ALONE,) if all(np.array_equal(*pair) for pair in pairs) else (PLAIN, EXTENDED)
