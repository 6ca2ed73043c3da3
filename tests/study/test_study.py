"""A study from its config to its table and report, as a user runs it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from commands import Command, run_here, summary, write_plugin
from studied import write_study

METHOD = """
@calibrators.register("{name}")
class Method(Calibrator):
    "Is for a test."

    bounded = False
    stochastic = False
    only_for = "robots on rails"

    def applies(self, robot):
        return {applies}

    def calibrate(self, problem):
        {body}
"""


def with_plugins(config: dict[str, Any], folder: Path) -> None:
    """Methods that fail or are not for these robots beside those of the study, and a robot that is not there."""
    bodies = {"fails": ("True", "raise ValueError('no luck')"), "on_rails": ("False", "return None")}
    for name, (applies, body) in bodies.items():
        write_plugin(folder / "plugins", name, METHOD.format(name=name, applies=applies, body=body))
    config["plugins"].append(str(folder / "plugins"))
    config["methods"] += [{"name": name, "family": "published"} for name in bodies]
    config["trainings"] = ["kind"]
    curve = {"by": "kind", "kinds": ["arc"], "runs_per_command": [1, 2]}
    config["robots"]["two"]["trainings"] = ["kind", "session", curve]
    config["robots"]["lost"] = {"path": "lost"}
    config["regimes"] = {"noise": {"noise_position": 0.05, "trainings": ["arc", "line"]}}


class Studied:
    """One run of the command, its folder and its table."""

    def __init__(self, run: Any, output: Path) -> None:
        self.run, self.output = run, output
        self.table = pl.read_parquet(output / "study.parquet")

    def rows(self, **values: str) -> pl.DataFrame:
        """The rows of the table with these values."""
        return self.table.filter(*(pl.col(name) == value for name, value in values.items()))


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Studied:
    folder = tmp_path_factory.mktemp("study")
    file = write_study(folder, lambda config: with_plugins(config, folder))
    return Studied(run_here("compare", file, "-o", folder / "out", cwd=folder), folder / "out")


def test_every_method_is_fitted_to_the_same_runs_and_judged_on_the_same_others(studied: Studied) -> None:
    answered = studied.rows(status="answered")
    of_cells = answered.group_by("robot", "training", "regime", "judged", "fitted").agg(
        pl.col("runs").n_unique().alias("runs"),
        pl.col("design_cost").n_unique().alias("designs"),
        pl.len().alias("rows"),
    )
    assert of_cells["runs"].to_list() == [1] * len(of_cells)
    assert of_cells["designs"].to_list() == [1] * len(of_cells)
    assert of_cells["rows"].to_list() == [3] * len(of_cells)


def test_a_calibration_on_arcs_is_better_than_the_design_on_lines_and_the_design_is_one_times_itself(
    studied: Studied,
) -> None:
    (row,) = studied.rows(robot="two", training="arc", judged="line", method="default", regime="as recorded").to_dicts()
    assert row["ratio"] < 0.5
    assert row["family_high"] < 1
    assert set(studied.rows(method="design")["ratio"].round(12)) == {1.0}


def test_a_method_that_fails_and_one_for_other_robots_are_rows(studied: Studied) -> None:
    for name, status, reason in (
        ("fails", "failed", "ValueError: no luck"),
        ("on_rails", "not applicable", "it is for robots on rails, and"),
    ):
        rows = studied.rows(method=name)
        assert len(rows) == len(studied.rows(method="default"))
        assert set(rows["status"]) == {status}
        assert all(each.startswith(reason) for each in rows["reason"])
        assert rows["cost"].null_count() == len(rows)


def test_recordings_that_are_not_there_are_a_row_and_exit_code_1(studied: Studied) -> None:
    (row,) = studied.rows(robot="lost").to_dicts()
    assert row["status"] == "recordings cannot be read"
    assert "lost" in row["reason"]
    assert studied.run.returncode == 1
    assert "cannot be read: lost" in studied.run.stdout
    assert "Traceback" not in studied.run.stderr


def test_a_regime_makes_its_own_cells_and_leaves_the_others_alone(studied: Studied) -> None:
    noisy = studied.rows(regime="noise", method="default", robot="two")
    assert set(noisy["training"]) == {"arc", "line"}
    assert noisy["cost"].sum() > studied.rows(regime="as recorded", method="default", robot="two").filter(
        pl.col("training").is_in(["arc", "line"]), ~pl.col("fitted")
    )["cost"].sum()  # fmt: skip


def test_the_answer_is_in_the_summary_and_on_the_terminal(studied: Studied) -> None:
    answer = summary(studied.output)
    assert 0 < answer["geometric_mean"] < 2
    assert {each["best"] for each in answer["against_best"]} == {"maddahi"}
    assert "Mean error of runs that did not train" in studied.run.stdout
    assert "Learning curves" in (studied.output / "report.html").read_text(encoding="utf-8")


def test_a_row_holds_the_matrix_that_its_errors_come_of(studied: Studied) -> None:
    same = studied.rows(method="design", robot="two")["matrix"].to_list()
    assert all(matrix == same[0] for matrix in same)
    assert studied.rows(method="default", robot="two", training="arc")["matrix"][0].to_list() != same[0]


def test_run_again_nothing_is_fitted_twice_and_the_table_is_the_same(studied: Studied) -> None:
    config = studied.output.parent / "study.yaml"
    again = run_here("compare", config, "-o", studied.output, cwd=config.parent)
    assert again.returncode == 1
    fitted = [line for line in again.stderr.splitlines() if line.startswith("[") and "kept" not in line]
    assert not [line for line in fitted if "failed" not in line and "not applicable" not in line]
    assert pl.read_parquet(studied.output / "study.parquet").equals(studied.table)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"methods": ["closed_from"], "reference": None}, "'closed_from' 'closed_form'"),
        ({"reference": "deafult"}, "reference: 'deafult'"),
        ({"data": "nowhere"}, "nowhere"),
        ({"trainings": ["kinds"]}, "trainings.0.by"),
        ({"seeds": [-1]}, "seeds.0"),
        ({"backend": "dusk"}, "'dusk' 'dask'"),
        ({"regimes": {"as recorded": {"noise_position": 1}}}, "'as recorded'"),
        ({"methods": [{"name": "closed_form", "trainings": "lime"}], "reference": None}, "'line'"),
        ({"methods": [{"name": "closed_form", "trainings": ["arc", "lime"]}], "reference": None}, "lime"),
        ({"methods": [{"name": "closed_form", "cost": "final_pos"}], "reference": None}, "'final_pose'"),
        ({"robots": {"one": {"format": "csv"}}}, "path"),
    ],
)
def test_a_mistake_in_the_config_is_one_line_and_exit_code_2(
    change: dict[str, Any], words: str, command: Command, tmp_path: Path
) -> None:
    run = command("compare", write_study(tmp_path, lambda config: config.update(change)), "-o", tmp_path / "out")
    assert run.returncode == 2
    assert all(word in run.stderr for word in words.split())
    assert [line[:6] for line in run.stderr.splitlines() if "reading" not in line] == ["error:"]
    assert not (tmp_path / "out").exists()


def lost_robot(config: dict[str, Any]) -> None:
    config["robots"]["two"] |= {"path": "lost", "kinds": {"spiral": "spiral_*"}}
    config["methods"][-1]["trainings"] = ["spiral"]


def elsewhere(config: dict[str, Any]) -> None:
    config |= {"data": "elsewhere", "trainings": ["kind"]}


def no_answer(config: dict[str, Any]) -> None:
    config["methods"] = [{"name": "theoretical", "label": "design"}, {"name": "fails"}]
    config |= {"plugins": ["plugins"], "reference": None, "trainings": ["kind"]}


@pytest.mark.parametrize(
    ("change", "arguments", "code", "words"),
    [
        (lost_robot, [], 1, "cannot be read: two"),
        (elsewhere, ["--data", "recordings"], 0, ""),
        (no_answer, [], 1, "no method gave an answer"),
    ],
)
def test_a_study_that_lacks_something_still_runs_and_its_exit_code_says_so(
    change: Callable[[dict[str, Any]], None],
    arguments: list[str],
    code: int,
    words: str,
    command: Command,
    tmp_path: Path,
) -> None:
    write_plugin(tmp_path / "plugins", "fails", METHOD.format(name="fails", applies="True", body="raise KeyError"))
    run = command("compare", write_study(tmp_path, change), "-o", tmp_path / "out", *arguments)
    assert run.returncode == code, run.stderr
    assert words in run.stdout + run.stderr
