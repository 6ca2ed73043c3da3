"""configs/real_robots.yaml on the recordings, and figures of the page on the paper that take minutes."""

from pathlib import Path

import pytest
from commands import CONFIGS, RECORDINGS
from page_figures import assert_printed, chain_figures, chain_results
from shared_results import made_once, shared_folder

from omnibench.compare.config import CompareConfig, TrainingChoice, read_compare_config
from omnibench.compare.output import cell_table
from omnibench.compare.plan import divide
from omnibench.compare.result import ComparisonResult
from omnibench.compare.run import run_comparison

pytestmark = pytest.mark.slow

CONFIG = CONFIGS / "real_robots.yaml"
METHODS = ("design", "map", "closed_form", "kallasi", "lin", "umbmark")


def selection() -> CompareConfig:
    """Two robots, whole kinds, methods that are fast."""
    config = read_compare_config(CONFIG)
    by_kind = (TrainingChoice(by="kind"),)
    robots = {name: config.robots[name].model_copy(update={"trainings": by_kind}) for name in ("tricyc", "omni3")}
    methods = tuple(method for method in config.methods if method.shown in METHODS)
    return config.model_copy(update={"robots": robots, "methods": methods, "regimes": {}, "workers": 1})


@made_once
def studied() -> ComparisonResult:
    """The study of the selection."""
    if not (RECORDINGS / "optiodom").is_dir():
        pytest.skip(f"the recordings are not at {RECORDINGS}")
    return run_comparison(selection(), shared_folder() / "real robots")


def position(result: ComparisonResult, robot: str, training: str, judged: str, method: str) -> tuple[float, float]:
    """Mean final error in m and degrees."""
    rows = cell_table(result).filter(robot=robot, training=training, judged=judged, method=method)
    (row,) = rows.to_dicts()
    return row["position_m"], row["heading_deg"]


@pytest.mark.parametrize(
    ("robot", "judged", "method", "figures"),
    [
        ("tricyc", "circular", "design", (0.664, 64.9)),
        ("tricyc", "square", "design", (0.771, 39.8)),
        ("tricyc", "circular", "kallasi", (0.0481, 3.33)),
        ("tricyc", "square", "kallasi", (0.0880, 2.93)),
        ("omni3", "circular", "design", (0.170, 14.8)),
        ("omni3", "square", "design", (0.1415, 7.12)),
        ("omni3", "circular", "lin", (0.0515, 3.67)),
        ("omni3", "square", "lin", (0.1070, 5.31)),
    ],
)
def test_the_figures_that_were_measured_beforehand_come_out_within_2_per_cent(
    robot: str, judged: str, method: str, figures: tuple[float, float]
) -> None:
    """Figures of ../shared/reference/robots.md, trained on all circular runs."""
    assert position(studied(), robot, "circular", judged, method) == pytest.approx(figures, rel=0.02)


def test_map_is_nowhere_worse_than_the_best_published_method_beyond_chance() -> None:
    compared = studied().against_best
    assert {each.cell.key.robot for each in compared} == {"tricyc", "omni3"}
    assert all(each.ratio.verdict != "worse" for each in compared)
    assert (studied().geometric_mean or 9) < 0.9


def test_a_lost_wheel_rate_explains_the_squares_of_the_omni_robot() -> None:
    assert position(studied(), "omni3", "circular", "square", "map")[0] < 0.05
    assert position(studied(), "omni3", "circular", "square", "closed_form")[0] > 0.09


def test_every_robot_of_the_config_is_divided_as_it_says() -> None:
    config = read_compare_config(CONFIG)
    for name in ("diff", "omni4", "corelli"):
        choice = config.robots[name]
        source = choice.source(config.data, name)
        if not Path(config.data / choice.path[0]).exists():
            pytest.skip(f"the recordings are not at {RECORDINGS}")
        dataset = source.load(name)
        trainings = divide(dataset, choice, choice.trainings or config.trainings, name)
        assert len(trainings) > 1
        assert all(fold.training and any(fold.judged.values()) for each in trainings for fold in each.folds)


def test_the_page_on_the_paper_prints_the_costs_of_the_simulated_robots(tmp_path: Path) -> None:
    assert_printed("chain", chain_figures(chain_results(tmp_path)))
