"""What the report of a discovery and its ``discovery.json`` say."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from browser import assert_picture_comes_first
from discovery_samples import (
    COUPLING,
    EXPERIMENT,
    held_out,
    incomplete,
    named,
    nameless,
    nothing,
    poor,
    shorn,
    simulated,
)
from lanes import slow
from pydantic_core import to_json
from report_page import NUMBER, Page
from sample_robots import LEVER_MECANUM
from syrupy.assertion import SnapshotAssertion

from omnibench.discover.discover import discover_effects
from omnibench.discover.report.discovery_report import (
    discovery_report,
    evidence_blocks,
    experiment_blocks,
    parameter_blocks,
)
from omnibench.discover.result import Absorbed, Discovery, EstimatedParameter, NotLookedFor, discovery_document
from omnibench.report.blocks import Document, Section
from omnibench.report.render import render


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


@pytest.fixture(scope="module")
def report() -> Page:
    return whole(named)


@pytest.mark.parametrize("make", [incomplete, nothing])
def test_the_report_reads_as_before(make: Callable[[], Discovery], snapshot: SnapshotAssertion) -> None:
    assert whole(make).words() == snapshot


@pytest.mark.parametrize(
    "make", [named, nothing, incomplete, lambda: poor(named()), lambda: poor(nothing()), *slow(nameless)]
)
def test_no_plot_is_empty_and_every_axis_has_a_title(make: Callable[[], Discovery]) -> None:
    drawn = plots(whole(make))
    assert len(drawn) > 8
    for each in drawn:
        assert each["data"]
        assert not any(is_empty(trace) for trace in each["data"])
        assert each["layout"]["xaxis"]["title"]["text"]


@pytest.mark.slow
def test_four_wheels_and_one_run_of_each_command_have_a_report() -> None:
    truth = {"tolerances": {"radius": 0.01, "seed": 1}}
    dataset = simulated((), robot=LEVER_MECANUM, truth=truth, repetitions=1, validation=None)
    drawn = plots(Page(render(discovery_report(discover_effects(dataset), ""))))
    assert not any(is_empty(trace) for each in drawn for trace in each["data"])


def test_the_commands_are_in_the_order_of_their_motions_and_few_are_named_below() -> None:
    few = named().dataset
    kept = {run.command for run in few.split("train") if run.alpha == 0 or run.omega == 0}
    runs = [run for run in few.split("train") if run.command in kept]
    names = {run.id for run in runs}
    found = named()
    chosen = [index for index, name in enumerate(found.trajectories) if name in names]
    less = {
        field: tuple(getattr(found, field)[index] for index in chosen)
        for field in ("trajectories", "before", "after", "whitened_before", "whitened_after")
    }
    told = whole(lambda: replace(found, **less)).text
    assert "1 0.2 m/s at 0°, −0.35 rad/s; 2 0.2 m/s at 0°, straight; 3 0.2 m/s at 60°, straight" in told


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
    blocks = tuple(parameter_blocks(replace(named(), effects=(effect,))))
    rows = part(Section("what", "", blocks)).tables["Parameters of the effects that were added"]
    assert rows[2][:3] == ["rollers", "10", "chosen among a few"]


def test_a_class_names_its_members_and_the_experiment_that_separates_them() -> None:
    effect = replace(named().effects[0], weight=0.52, confusable_with=("load_transfer",), in_doubt="few turns")
    found = replace(named(), verdict="class", effects=(effect,), experiments=(EXPERIMENT,))
    blocks = (*parameter_blocks(found), *experiment_blocks(found), *evidence_blocks(found))
    told = part(Section("all", "", blocks))
    assert "weight 52.0 %, cannot be told from load_transfer" in told.text
    assert "In doubt: few turns" in told.text
    assert EXPERIMENT.description in told.text
    rows = told.tables["What to drive to tell acceleration_slip from its look-alikes"]
    assert rows[1:] == [["turning left on the spot at 1 rad/s", "12.5", "4"]]
    assert EXPERIMENT.config in told.text


def test_the_first_screen_says_how_sure_the_cause_is() -> None:
    effect = replace(named().effects[0], weight=0.52, confusable_with=("load_transfer",))
    alike = whole(lambda: replace(named(), verdict="class", effects=(effect,))).text
    assert "(rotation translation coupling; it may as well be load transfer)" in alike
    assert "found; which of a class is open; weight of the name 52.0 %" in alike
    assert "likeliest, but no name is sure" in whole(lambda: replace(named(), verdict="unknown")).text
    nameless = replace(named(), verdict="unknown", effects=())
    assert "the rate that its class usually loses closes" in whole(lambda: nameless).text
    unnamed = tuple(replace(step, name="+ unnamed, over heading") for step in nameless.steps)
    assert "a term without a name closes" in whole(lambda: replace(nameless, steps=unnamed)).text


def test_errors_before_and_after_stand_beside_the_floor(report: Page) -> None:
    rows = report.tables["On held-out runs"]
    session = held_out(named(), "session")
    start = next(index for index, row in enumerate(rows) if row[0].startswith("held-out session"))
    before, after, floor = (float(value) for value in rows[start + 1][1:4])
    assert before == pytest.approx(session.eq6.before, rel=0.01)
    assert after == pytest.approx(session.eq6.after, rel=0.01)
    assert floor == pytest.approx(session.eq6.floor, rel=0.01)


def test_recorded_data_wear_no_badge_and_hostile_names_stay_words() -> None:
    name = "<script>alert(1)</script>"
    dataset = replace(named().dataset, name=name, description=name, simulated=False)
    found = replace(named(), dataset=shorn(dataset, command=name), measurements=(Absorbed(name, "body", name),))
    told = Page(render(discovery_report(found, name)))
    assert "SIMULATED DATA" not in told.text
    assert name in told.text
    assert name not in told.html


@pytest.mark.slow
@pytest.mark.parametrize("make", [named, nothing, nameless])
def test_the_paths_stand_in_the_first_900_pixels(make: Callable[[], Discovery], tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(render(discovery_report(make(), "seed: 0\n")), encoding="utf-8")
    assert_picture_comes_first(tmp_path / "report.html")


def test_a_discovery_is_written_with_names_and_paths_in_the_place_of_data_and_models(
    snapshot: SnapshotAssertion,
) -> None:
    effect = incomplete().effects[0]
    shape = EstimatedParameter("length", 0.05, "m", 0.05, 0.05, shape=True)  # has no interval
    found = replace(
        incomplete(),
        dataset_hash="of the whole recording",  # not of the runs without outliers
        effects=(replace(effect, parameters=(*effect.parameters, shape)),),
        not_looked_for=(NotLookedFor("tyre_wear", "all runs are of one session"),),
    )
    written = json.loads(to_json(discovery_document(found, Path("/results"))))
    assert written["runs"] == len(found.trajectories)
    assert written["noise"]["components"] == found.noise.noise.model_dump()
    session, held_out = written["held_out"]["session"], found.held_out[-1]
    assert session["position_m"] == dict(zip(("before", "after"), held_out.position_m, strict=True))
    assert NUMBER.sub("#", json.dumps(written, indent=1)) == snapshot
