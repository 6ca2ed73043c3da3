"""The part of the report that says where: what the residuals depend on, and pictures of it, the telling ones first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from omnibench.discover.report.before_after import ALONE, EXTENDED, PLAIN, Look
from omnibench.discover.report.command_figures import command_blocks
from omnibench.discover.report.floor_figures import floor_grids
from omnibench.discover.report.motion_figures import acceleration_grid, heading_grid, wheel_angle_grid, wheel_rate_grid
from omnibench.discover.report.motor_figures import motor_grid
from omnibench.discover.report.residuals import Residuals
from omnibench.discover.report.tables import place_table
from omnibench.discover.report.time_figures import elapsed_grid, order_grid, stamps_grid
from omnibench.discover.result import Discovery
from omnibench.report.blocks import Block, Details, Paragraph, Section
from omnibench.report.numbers import listing

_Grids = Callable[[Residuals, Sequence[Look]], Sequence[Block | None]]
# Pictures of each covariate, in the order of the catalogue of places.
_PICTURES: Mapping[str, _Grids] = {
    "elapsed time": lambda residuals, looks: [elapsed_grid(residuals, looks)],
    "heading": lambda residuals, looks: [heading_grid(residuals, looks)],
    "place": floor_grids,
    "order of runs": lambda residuals, looks: [order_grid(residuals, looks)],
    "wheel rate": lambda residuals, looks: [wheel_rate_grid(residuals, looks)],
    "wheel angle": lambda residuals, looks: [wheel_angle_grid(residuals, looks)],
    "acceleration": lambda residuals, looks: [acceleration_grid(residuals, looks)],
    "stamps": lambda residuals, looks: [stamps_grid(residuals, looks)],
}
_HOW = (
    "In the pictures over a covariate a point is the error of the motion that, constant in its bin, explains the "
    "residuals best together with those of the other bins (generalised least squares under the noise model); what the "
    "matrix could take up of it is gone already. The bands, in the colour of each model, hold 95 % of what comes out "
    "by chance: of noise, or of the same residuals with random signs for whole commands or runs, so that what depends "
    "on something else does not stand out."
)
_OVER = {"elapsed time": "the time of a run", "place": "the floor", "order of runs": "the order of the runs"}
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
    """What the residuals depend on, by covariate, before and after."""
    residuals = Residuals(discovery)
    looks = _looks(discovery)
    motors = motor_grid(discovery, residuals.runs)
    drawn = {name: tuple(block for block in make(residuals, looks) if block) for name, make in _PICTURES.items()}
    drawn["motors"] = () if motors is None else (motors,)
    places = ["motors" if place.stage == "actuator" else place.covariate for place in discovery.where]
    named = [name for name in dict.fromkeys(places) if name in drawn]
    sections = [Section("where-command", "Residuals by command", command_blocks(residuals, looks))]
    for number, name in enumerate(named, 1):
        if drawn[name]:
            sections.append(Section(f"where-{number}", _title(name), drawn[name]))
    others: list[Block] = [
        Details(_title(name), blocks) for name, blocks in drawn.items() if name not in named and blocks
    ]
    not_drawn = [f"{name} ({_NOT_DRAWN[name]})" for name, blocks in drawn.items() if not blocks]
    if not_drawn:
        others.append(Paragraph(f"Not drawn: {'; '.join(not_drawn)}.", "note"))
    if others:
        title = "Residuals over other things" if named else "Residuals over all that was looked at"
        sections.append(Section("where-others", title, tuple(others)))
    return Section("where", "Where", (*_places(discovery), Paragraph(_HOW, "note")), tuple(sections))


def _title(name: str) -> str:
    return (
        "Measured wheel rates against their targets" if name == "motors" else f"Residuals over {_OVER.get(name, name)}"
    )


def _places(discovery: Discovery) -> Iterator[Block]:
    if not discovery.where:
        yield Paragraph(
            "The residuals of the plain matrix depend on nothing that was looked at by more than noise explains."
        )
        return
    words = listing(list(dict.fromkeys(place.covariate for place in discovery.where if place.stage != "actuator")), 9)
    if words:
        yield Paragraph(
            f"The residuals of the plain matrix depend on {words}. What makes them may show in several of these; the "
            "first stands out most."
        )
    if any(place.stage == "actuator" for place in discovery.where):
        yield Paragraph(
            "The wheels do not turn as their motors were told. Odometry sees the wheels themselves and is not worse "
            "for it; a simulation is."
        )
    yield place_table(discovery.where, "Where the plain matrix fails")


def _looks(discovery: Discovery) -> tuple[Look, ...]:
    """Both models, or the plain one alone where nothing was added."""
    pairs = zip(discovery.before, discovery.after, strict=True)
    return (ALONE,) if all(np.array_equal(*pair) for pair in pairs) else (PLAIN, EXTENDED)
