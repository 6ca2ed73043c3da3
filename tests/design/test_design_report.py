"""What a design says on a page and on a terminal."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from browser import assert_picture_comes_first
from report_page import Page, on_terminal
from report_samples import flower
from sample_robots import APR02, LEVER_MECANUM

from omnibench.design.candidates import DesignConfig, candidates_of_config, candidates_of_dataset
from omnibench.design.design import Design, design_experiment
from omnibench.design.report import DesignResult
from omnibench.report.render import write_document
from omnibench.report.terminal import print_result, print_table
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

STAR = {"speeds": [0.2], "directions_deg": [0, 90, 180, 270], "turn_rates": [-0.35, 0, 0.35], "distance": 1}
SPOT = {"speed": 0, "turn_rate": 1.0, "duration": 6}


def designed(sets: dict[str, Any] | None = None, **arguments: Any) -> Design:
    chosen = sets or {"star": STAR, "more": [{"set": "star"}, SPOT]}
    config = DesignConfig.model_validate(
        {
            "name": "small",
            "description": "A small design.",
            "notes": ["Nobody has driven this."],
            "robot": APR02,
            "sample_period": 0.05,
            "noise": {"pose_position": 0.005, "pose_heading": 0.005},
            "sets": chosen,
            "baseline": {"set": next(iter(chosen)), "repetitions": 2},
        }
    )
    return design_experiment(candidates_of_config(config), **arguments)


def page(design: Design, folder: Path) -> Page:
    write_document(DesignResult(design).document(), folder / "report.html")
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def printed(design: Design, width: int = 100) -> str:
    return on_terminal(print_result, DesignResult(design), width=width)


def plots(told: Page) -> list[dict[str, Any]]:
    found = re.findall(r'<script type="application/json" id="[^"]+">(.*?)</script>', told.html)
    return [json.loads(each) for each in found]


@pytest.fixture(scope="module")
def design() -> Design:
    return designed()


@pytest.fixture(scope="module")
def report(design: Design, tmp_path_factory: pytest.TempPathFactory) -> Page:
    return page(design, tmp_path_factory.mktemp("report"))


def test_the_report_answers_first_and_no_line_of_a_table_is_wider_than_the_terminal(
    design: Design, report: Page
) -> None:
    assert report.sections == ["answer", "commands", "precision", "basis"]
    assert "ASSUMED NOISE, NO RECORDINGS" in report.text
    told = printed(design)
    assert "of the information per run that no design from these 12 commands exceeds" in told
    for table in DesignResult(design).tables():
        assert max(map(len, on_terminal(print_table, table, width=100).splitlines())) <= 100
    assert "…" not in told


def test_simulated_recordings_wear_a_badge_and_their_noise_is_estimated(tmp_path: Path) -> None:
    config = FlowerConfig.model_validate(flower())
    told = page(design_experiment(candidates_of_dataset(simulate_dataset(config).dataset)), tmp_path)
    assert "SIMULATED DATA" in told.text
    assert "of 8 commands" in told.text


def test_the_chosen_commands_stand_in_tables(design: Design, report: Page) -> None:
    for found in design.sets:
        caption = next(name for name in report.tables if name.startswith(f"What to drive of {found.name}: "))
        rows = report.tables[caption][1:]
        assert [row[0].split(" | ")[1] for row in rows] == [each.command for each in found.chosen]
        assert [int(row[4]) for row in rows] == [each.runs for each in found.chosen]
    caption = next(name for name in report.tables if name.startswith("As good as the baseline"))
    equals = [equal.effort for found in design.sets for equal in found.equivalents]
    assert [row[2] for row in report.tables[caption][1:]] == [str(effort.runs) for effort in equals]
    assert len(report.tables["All 13 candidates"]) == 1 + len(design.candidates)


def test_plots_show_a_path_for_every_candidate_and_none_is_empty(design: Design, report: Page) -> None:
    drawn = plots(report)
    assert len(drawn) == report.plots == 2 + 1
    for found, flower_plot in zip(design.sets, drawn, strict=False):
        lines = [trace for trace in flower_plot["data"] if trace["mode"] == "lines"]
        assert len(lines) == len(found.commands)
        chosen = [trace for trace in lines if trace["legendgroup"] != "unused"]
        assert len(chosen) == len(found.chosen)
        driven = {each.runs: trace["line"]["width"] for each, trace in zip(found.chosen, chosen, strict=True)}
        assert sorted(driven.values()) == [driven[runs] for runs in sorted(driven)]
    for each in drawn:
        assert all(len(trace["x"]) == len(trace["y"]) > 0 for trace in each["data"])


def test_a_turn_on_the_spot_is_drawn_as_an_arc(tmp_path: Path) -> None:
    straight = {**STAR, "turn_rates": [0]}
    design = designed({"cross": [straight, SPOT]})
    assert any(each.command == "v0_a0_w1" for each in design.sets[0].chosen)
    drawn = plots(page(design, tmp_path))[0]
    arc = next(t for t in drawn["data"] if t["mode"] == "lines" and "on the spot" in t["hovertemplate"])
    radii = [(x**2 + y**2) ** 0.5 for x, y in zip(arc["x"], arc["y"], strict=True)]
    assert max(radii) - min(radii) < 1e-3 < min(radii)


def test_axes_of_precision_are_logarithmic_and_their_labels_readable(report: Page) -> None:
    layout = plots(report)[2]["layout"]
    for axis in (layout["xaxis"], layout["yaxis"]):
        assert axis["type"] == "log"
        assert not any("e+" in label for label in axis["ticktext"])


def test_four_wheels_have_a_report_without_physical_parameters(tmp_path: Path) -> None:
    config = flower(robot=LEVER_MECANUM, truth={"tolerances": {"radius": 0.02, "seed": 1}})
    dataset = simulate_dataset(FlowerConfig.model_validate(config)).dataset
    told = page(design_experiment(candidates_of_dataset(dataset)), tmp_path)
    assert told.plots == 2


def test_hostile_names_stay_words(tmp_path: Path) -> None:
    name = "<script>alert(1)</script>"
    told = page(designed({name: STAR}), tmp_path)
    assert name in told.text
    assert name not in told.html


def test_limits_that_leave_no_equal_are_told(tmp_path: Path) -> None:
    design = designed({"star": STAR}, repetitions=1)
    told = page(design, tmp_path)
    caption = next(name for name in told.tables if name.startswith("As good as the baseline"))
    assert told.tables[caption][1][2] == "– | not within the repetitions allowed"
    assert re.search(r"star +final poses +– \(not within the repetitions allowed\)", printed(design, 160))


@pytest.mark.slow
def test_what_to_drive_stands_as_a_picture_in_the_first_900_pixels(design: Design, tmp_path: Path) -> None:
    page(design, tmp_path)
    assert_picture_comes_first(tmp_path / "report.html")
