"""What the report of a discovery says."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import first_picture
from discovery_samples import (
    COUPLING,
    EXPERIMENT,
    EXTRAPOLATION,
    held_out,
    incomplete,
    named,
    nameless,
    nothing,
    poor,
    shorn,
    simulated,
)
from report_page import Page

from omnibench.discover.discover import discover_effects
from omnibench.discover.report.discovery_report import discovery_report, sure_blocks, what_blocks
from omnibench.discover.report.evidence_figures import command_blocks
from omnibench.discover.report.motion_figures import grid
from omnibench.discover.report.residuals import ALONE, EXTENDED, PLAIN, Curve, Panel, Residuals
from omnibench.discover.report.tables import decisive
from omnibench.discover.result import Absorbed, Discovery, EstimatedParameter
from omnibench.report.blocks import Document, FigureGrid, Section
from omnibench.report.render import render

TOP = ("answer", "what", "better", "where", "sure", "basis")


@cache
def whole(make: Callable[[], Discovery]) -> Page:
    """The whole report of a discovery."""
    return Page(render(discovery_report(make(), "seed: 0\n")))


def part(section: Section) -> Page:
    """A section by itself, which is faster."""
    return Page(render(Document("", "", (section,))))


def plots(told: Page) -> list[dict[str, Any]]:
    texts = re.findall(r'<script type="application/json" id="[^"]+">(.*?)</script>', told.html)
    return [json.loads(each) for each in texts]


def is_empty(trace: dict[str, Any]) -> bool:
    values = trace.get("z") or trace.get("y") or []
    flat = [value for row in values for value in (row if isinstance(row, list) else [row])]
    return not any(value is not None for value in flat)


def poor_named() -> Discovery:
    return poor(named())


def poor_nothing() -> Discovery:
    return poor(nothing())


@pytest.fixture(scope="module")
def report() -> Page:
    return whole(named)


def test_the_story_goes_answer_what_how_much_better_where_how_sure(report: Page) -> None:
    assert [each for each in report.sections if each in TOP] == list(TOP)


def test_simulated_data_wear_a_badge(report: Page) -> None:
    assert "SIMULATED DATA" in report.text


@pytest.mark.parametrize("make", [named, nothing, nameless, incomplete, poor_named, poor_nothing])
def test_no_plot_is_empty_and_every_axis_has_a_title(make: Callable[[], Discovery]) -> None:
    drawn = plots(whole(make))
    assert len(drawn) > 8
    for each in drawn:
        assert each["data"]
        assert not any(is_empty(trace) for trace in each["data"])
        assert each["layout"]["xaxis"]["title"]["text"]


def test_four_wheels_and_one_run_of_each_command_have_a_report() -> None:
    wheels = [
        {"name": name, "radius": 0.05, "distance": 0.35, "angle": angle, "roller_angle": roller}
        for name, angle, roller in (
            ("fl", 1.57, 0.785), ("fr", -1.57, -0.785), ("rl", 1.57, -0.785), ("rr", -1.57, 0.785),
        )
    ]  # fmt: skip
    dataset = simulated(
        (), robot={"name": "mecanum", "wheels": wheels}, truth={"tolerances": {"radius": 0.01, "seed": 1}},
        repetitions=1, validation=None,
    )  # fmt: skip
    drawn = plots(Page(render(discovery_report(discover_effects(dataset), ""))))
    assert not any(is_empty(trace) for each in drawn for trace in each["data"])


def test_what_the_residuals_depend_on_comes_first_in_pictures_and_the_rest_is_folded(report: Page) -> None:
    covariates = list(dict.fromkeys(place.covariate for place in named().where))
    words = {"order of runs": "the order of the runs", "place": "the floor", "elapsed time": "the time of a run"}
    headings = [f"Residuals over {words.get(each, each)}" for each in covariates if each != "command"]
    positions = [report.text.rindex(heading) for heading in headings]
    assert positions == sorted(positions)
    assert "Residuals over other covariates" in report.text
    assert "<summary>Residuals over acceleration</summary>" in report.html


def test_every_place_stands_in_a_table_with_its_significance(report: Page) -> None:
    rows = report.tables["Where the plain matrix fails"][1:]
    assert [row[0].split(" | ")[0] for row in rows] == [place.covariate for place in named().where]
    assert all(re.search(r"10⁻|0\.", row[2]) for row in rows)


def test_parameters_have_intervals_and_units(report: Page) -> None:
    rows = report.tables["Parameters of the effects that were added"]
    assert re.search(r"rotation_translation_coupling \(body\), weight 9[5-9]\.\d %; as in the textbook", rows[1][0])
    for row, name, true in zip(rows[2:], ("kx", "ky"), COUPLING[0]["parameters"].values(), strict=True):
        assert row[0].startswith(f"{name} | relative change of the rate of turn")
        assert row[3] == "s/m"
        low, high = (float(value.replace("−", "-")) for value in row[2].split(" to "))
        assert low < float(row[1].replace("−", "-")) < high
        assert abs(float(row[1].replace("−", "-")) - true) < 0.05


def test_a_shape_was_chosen_and_has_no_interval() -> None:
    effect = replace(named().effects[0], parameters=(EstimatedParameter("rollers", 10.0, "1", 10.0, 10.0, shape=True),))
    blocks = tuple(what_blocks(replace(named(), effects=(effect,))))
    rows = part(Section("what", "", blocks)).tables["Parameters of the effects that were added"]
    assert rows[2][:3] == ["rollers", "10", "chosen among a few"]


def test_a_class_names_its_members_and_the_experiment_that_separates_them() -> None:
    effect = replace(named().effects[0], weight=0.52, confusable_with=("load_transfer",), in_doubt="few turns")
    found = replace(named(), verdict="class", effects=(effect,), experiments=(EXPERIMENT,))
    told = part(Section("both", "", (*what_blocks(found), *sure_blocks(found))))
    assert "These data cannot tell it from load_transfer" in told.text
    assert "In doubt: few turns" in told.text
    assert EXPERIMENT.description in told.text
    rows = told.tables["What to drive to tell acceleration_slip from its look-alikes"]
    assert rows[1:] == [["turning left on the spot at 1 rad/s", "12.5", "4"]]
    assert EXPERIMENT.config in told.text
    assert "52.0 %" in told.text


def test_without_an_effect_the_report_says_how_large_each_could_still_be() -> None:
    found = nothing()
    told = whole(nothing)
    assert "Parameters of the effects that were added" not in told.tables
    rows = told.tables["How large an effect of each kind could still hide"][1:]
    assert len(rows) == len(found.hidden) > 5
    shares = [float(re.sub(r"[>,% ]", "", row[6])) for row in rows]
    assert shares == sorted(shares, reverse=True)


def test_what_has_no_name_is_said_with_its_place() -> None:
    told = whole(nameless)
    assert "something is missing that has no name" in told.text
    assert "What the residuals still depend on, after all that was added" in told.tables


def test_absorbed_effects_come_with_the_measurement_that_would_tell(report: Page) -> None:
    rows = report.tables["Absorbed: any of these may be there, and no odometry run would show it"][1:]
    assert {row[0]: row[2] for row in rows} == {each.name: each.measurement for each in named().measurements}
    assert "lidar_yaw" in [row[0] for row in rows]


def test_a_figure_of_which_no_more_values_leave_their_bands_than_by_chance_says_so() -> None:
    x = np.arange(20.0)

    def caption(largest: float) -> str:
        curve = Curve(ALONE, np.where(x < 2, largest, 0.1), np.ones(20))
        drawn = grid([Panel("", x, (curve,), "", "", "%")], (ALONE,))
        assert drawn is not None
        return drawn.caption

    assert caption(0.5).startswith("No more than by chance, of the plain matrix 0 of 20 values leave their band.")
    assert caption(1.5) == ""


def test_a_class_of_effects_has_a_short_tile() -> None:
    found = named()
    (effect,) = found.effects
    several = replace(effect, confusable_with=("heading_drift", "coulomb_creep", "wheel_dead_zone"))
    told = part(discovery_report(replace(found, effects=(several,)), "").sections[0])
    assert "rotation translation coupling or 3 others" in told.text
    assert "it may as well be heading drift, coulomb creep and wheel dead zone" in told.text


def test_new_motions_are_a_warning_with_both_bounds() -> None:
    told = whole(incomplete)
    assert f"{EXTRAPOLATION.command}: {EXTRAPOLATION.description}." in told.text
    assert "within 41.0 mm by the plain matrix, within 152 mm by the extended model" in told.text
    assert "callout warning" in told.html


def test_errors_before_and_after_stand_beside_the_floor(report: Page) -> None:
    rows = report.tables["On held-out runs"]
    session = held_out(named(), "session")
    start = next(index for index, row in enumerate(rows) if row[0].startswith("held-out session"))
    before, after, floor = (float(value) for value in rows[start + 1][1:4])
    assert before == pytest.approx(session.eq6.before, rel=0.01)
    assert after == pytest.approx(session.eq6.after, rel=0.01)
    assert floor == pytest.approx(session.eq6.floor, rel=0.01)


def test_each_effect_is_a_step_of_the_waterfall(report: Page) -> None:
    rows = report.tables["Step by step"][1:]
    assert [row[0] for row in rows] == ["plain matrix", "+ rotation_translation_coupling"]
    bars = [each for each in plots(report) if any(trace.get("legendgroup") == "down" for trace in each["data"])]
    assert len(bars) == 2


def test_the_chosen_candidate_stands_out_among_the_others(report: Page) -> None:
    assert "Step 1: rotation_translation_coupling is added" in report.text


def test_what_cannot_be_drawn_is_said_with_the_reason() -> None:
    told = whole(poor_nothing)
    assert "wheel angle (the wheels' absolute angles were not recorded)" in told.text
    assert "order of runs (when the runs were driven was not recorded)" in told.text


def test_commands_without_a_direction_are_listed_in_rows() -> None:
    dataset = shorn(named().dataset, v=None, alpha=None, omega=None)
    blocks = command_blocks(Residuals(replace(named(), dataset=dataset)), (PLAIN, EXTENDED))
    titles = [figure.title for block in blocks if isinstance(block, FigureGrid) for figure in block.figures]
    assert titles[-3:] == ["Final residual forward", "Final residual to the left", "Final heading residual"]


def test_recorded_data_wear_no_badge_and_hostile_names_stay_words() -> None:
    name = "<script>alert(1)</script>"
    dataset = replace(named().dataset, name=name, description=name, simulated=False)
    found = replace(named(), dataset=shorn(dataset, command=name), measurements=(Absorbed(name, "body", name),))
    told = Page(render(discovery_report(found, name)))
    assert "SIMULATED DATA" not in told.text
    assert name in told.text
    assert name not in told.html


def test_the_options_are_there_to_reproduce_it(report: Page) -> None:
    assert "seed: 0" in report.text


def test_the_answer_is_the_cause_in_plain_words_and_what_it_gains(report: Page) -> None:
    held = decisive(named())
    before, after = (f"{1e3 * metres:.0f} mm" for metres in held.position_m)
    assert "The robot turns faster or slower the faster it drives (rotation translation coupling)" in report.text
    assert f"the held-out error goes from {before} and" in report.text
    assert f"to {after} and" in report.text


@pytest.mark.parametrize("make", [named, nothing, nameless])
def test_the_paths_stand_in_the_first_900_pixels(make: Callable[[], Discovery], tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(render(discovery_report(make(), "seed: 0\n")), encoding="utf-8")
    bottom, width = first_picture(tmp_path / "report.html")
    assert bottom <= 900
    assert width <= 1280
