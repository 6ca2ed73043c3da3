"""Only runs that are new, changed or damaged are run; all others are read from the results that are there."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import files_of, flower, registries_restored, search, small, summary, without_seconds, write_plugin

from omnibench.compare.config import CompareConfig, effective_config
from omnibench.compare.plan import load_datasets, make_plan
from omnibench.compare.run import run_comparison
from omnibench.progress import Progress


class Watch:
    """A reporter that notes which runs were run and which were there."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.kept: list[str] = []

    def __call__(self, event: Progress) -> None:
        if event.result:
            run = event.task.removeprefix("flower ").replace(" seed", "")
            (self.kept if "kept from an earlier run" in event.result else self.ran).append(run)


def ran_and_kept(output: Path, **changes: Any) -> tuple[set[str], set[str]]:
    """Compare a small config, changed, and say which runs were run and which were there."""
    watch = Watch()
    run_comparison(CompareConfig.model_validate(small(**changes)), output, watch)
    return set(watch.ran), set(watch.kept)


ALL = {"theoretical 1", "closed_form 1", "search 1"}


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("once") / "out"
    ran_and_kept(output)
    return output


@pytest.fixture
def output(once: Path, tmp_path: Path) -> Path:
    """Results of the small comparison."""
    shutil.copytree(once, tmp_path / "out")
    return tmp_path / "out"


def test_nothing_is_run_again_when_nothing_changed(output: Path) -> None:
    before, rows = files_of(output / "runs"), summary(output)["runs"]
    assert ran_and_kept(output) == (set(), ALL)
    assert files_of(output / "runs") == before
    assert summary(output)["runs"] == rows


def test_only_what_is_new_is_run(output: Path) -> None:
    entries = ["theoretical", {"name": "closed_form", "label": "another name"}, search(candidates=301)]
    assert ran_and_kept(output, calibrators=entries) == ({"search 1"}, {"theoretical 1", "another name 1"})


@pytest.mark.parametrize(
    ("changes", "new"),
    [
        ({"calibrators": ["theoretical", "closed_form", search(candidates=301)]}, {"search 1"}),
        ({"calibrators": ["theoretical", {"name": "closed_form", "box": "paper", "label": "c"}, search()]}, {"c 1"}),
        ({"calibrators": ["theoretical", "closed_form", search("another name")]}, set()),
        ({"seeds": [1, 2]}, {"search 2"}),
        ({"budget": {"evaluations": 2001, "seconds": 60}}, ALL),
        ({"cost": "final_position"}, ALL),
        ({"integration": "euler"}, ALL),
        ({"datasets": {"flower": {"simulate": flower(sample_period=0.1)}}}, ALL),
        ({"workers": 1, "bootstrap": {"resamples": 300}, "description": "other words"}, set()),
    ],
    ids=lambda value: ", ".join(sorted(value)) or "nothing",
)
def test_only_runs_that_a_change_touches_are_new(once: Path, changes: dict[str, Any], new: set[str]) -> None:
    config = CompareConfig.model_validate(small(**changes))
    plan = make_plan(effective_config(config), load_datasets(config))
    assert {f"{run.label} {run.seed}" for run in plan if not (once / "runs" / f"{run.key}.json").exists()} == new


def test_damaged_runs_are_run_again(output: Path) -> None:
    files = sorted((output / "runs").iterdir())
    damages = (b"", b"\xff\xfe", b'{"outcome": "converged"}')
    for file, damage in zip(files, damages, strict=True):
        file.write_bytes(damage)
    assert ran_and_kept(output) == (ALL, set())
    assert sorted((output / "runs").iterdir()) == files
    assert min(len(file.read_bytes()) for file in files) > 100


PLUGIN = """
@calibrators.register("mine")
class Mine(Calibrator):
    "Scales the start."

    def calibrate(self, problem):
        return Solution(problem.start * {factor}, "scaled")
"""


def test_a_plugin_that_is_repaired_or_changed_is_run_again_and_the_others_are_not(tmp_path: Path) -> None:
    costs = []
    for factor, outcome in (("a_name_that_is_not_there", "failed"), ("1.0", "converged"), ("1.01", "converged")):
        plugins = write_plugin(tmp_path / "plugins", "mine", PLUGIN.format(factor=factor))
        changes: dict[str, Any] = {"plugins": [str(plugins)], "calibrators": ["theoretical", "mine"]}
        with registries_restored():
            ran, _ = ran_and_kept(tmp_path / "out", **changes)
        assert ran == ({"mine 1"} if costs else {"mine 1", "theoretical 1"})
        theoretical, mine = summary(tmp_path / "out")["runs"]
        assert (theoretical["outcome"], mine["outcome"]) == ("converged", outcome)
        costs.append(mine["train_cost"])
    assert costs[0] is None
    assert costs[1] != costs[2]


def test_the_same_seed_gives_the_same_results_with_any_number_of_workers(tmp_path: Path) -> None:
    entries = ["theoretical", "closed_form", search(), {"name": "genetic", "options": {"generations": 4}}]
    for workers in (1, 3):
        ran_and_kept(tmp_path / str(workers), calibrators=entries, seeds=[1, 7], workers=workers)
    assert without_seconds(tmp_path / "1") == without_seconds(tmp_path / "3")
    assert len(without_seconds(tmp_path / "1")) == 6
