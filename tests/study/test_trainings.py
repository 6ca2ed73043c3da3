"""Which runs train and which judge, and training runs made worse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from commands import refused
from sample_robots import DIFFERENTIAL
from studied import robot_dataset

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import DataError, OmnibenchError
from omnibench.study.config import RegimeChoice, RobotChoice, TrainingChoice
from omnibench.study.study_plan import Training, divide, in_regime

KINDS = {"line": ("line_*",), "arc": ("arc_*",)}


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return robot_dataset(DIFFERENTIAL, "two wheels", 1)


def divided(dataset: Dataset, *rules: TrainingChoice, kinds: dict[str, tuple[str, ...]] = KINDS) -> dict[str, Training]:
    choice = RobotChoice(path=("x",), kinds=kinds)
    return {training.name: training for training in divide(dataset, choice, rules, "robot two")}


@pytest.mark.parametrize(
    "rule",
    [
        TrainingChoice(by="kind"),
        TrainingChoice(by="session"),
        TrainingChoice(by="kind", runs_per_command=(1, 2)),
        TrainingChoice(leave_out="session"),
        TrainingChoice(leave_out="command"),
        TrainingChoice(leave_out="kind"),
    ],
    ids=str,
)
def test_no_run_judges_what_it_trained(dataset: Dataset, rule: TrainingChoice) -> None:
    for training in divided(dataset, rule).values():
        for fold in training.folds:
            trained = {run.id for run in fold.training}
            judging = {dataset.trajectories[index].id for indices in fold.judged.values() for index in indices}
            assert trained
            assert judging
            assert not trained & judging


def test_one_session_trains_and_all_other_sessions_and_kinds_judge(dataset: Dataset) -> None:
    training = divided(dataset, TrainingChoice(by="session"))["arc, one session"]
    fold = training.folds[0]
    assert {run.session for run in fold.training} == {fold.session} == {"arc day 0"}
    of_kinds = {kind: {dataset.trajectories[index].session for index in runs} for kind, runs in fold.judged.items()}
    assert of_kinds == {"line": {f"line day {day}" for day in range(3)}, "arc": {"arc day 1", "arc day 2"}}


def test_a_learning_curve_is_judged_by_the_same_runs_at_every_length(dataset: Dataset) -> None:
    trainings = divided(dataset, TrainingChoice(by="kind", kinds=("arc",), runs_per_command=(1, 2)))
    short, long = (trainings[f"arc, {words} a command"].folds[0] for words in ("1 run", "2 runs"))
    assert (len(short.training), len(long.training)) == (2, 4)
    assert short.judged == long.judged


def test_without_a_session_the_kind_judges_that_session_alone(dataset: Dataset) -> None:
    fold = divided(dataset, TrainingChoice(leave_out="session"))["line, a session left out"].folds[1]
    assert {dataset.trajectories[index].session for index in fold.judged["line"]} == {"line day 1"}
    assert {run.session for run in fold.training} == {"line day 0", "line day 2"}


def test_a_copy_of_a_training_run_does_not_judge(dataset: Dataset) -> None:
    runs = dataset.trajectories
    copied = make_dataset("copied", DIFFERENTIAL, dataset.sample_period, [*runs, replace(runs[0], id="arc_copy")])
    fold = divided(copied, TrainingChoice(by="kind"))["line"].folds[0]
    assert "arc_copy" not in {copied.trajectories[index].id for index in fold.judged["arc"]}


def test_a_data_sets_own_split_is_kept(dataset: Dataset) -> None:
    runs = [replace(run, split="validation" if "_2_" in run.id else "train") for run in dataset.trajectories]
    halved = make_dataset("halved", DIFFERENTIAL, dataset.sample_period, runs)
    fold = divided(halved, TrainingChoice(by="split"), kinds={})["own split"].folds[0]
    judging = {halved.trajectories[index].id for index in fold.judged["all paths"]}
    assert judging == {run.id for run in runs if run.split == "validation"}


@pytest.mark.parametrize(
    ("kinds", "rule", "words"),
    [
        ({"arc": ("arcs_*",)}, TrainingChoice(by="kind"), "no run is of kind arc (arcs_*)"),
        ({"arc": ("arc_*",), "all": ("*",)}, TrainingChoice(by="kind"), "is of kinds arc and all"),
        (KINDS, TrainingChoice(by="kind", kinds=("arcs",)), "no kind 'arcs' to train on; did you mean 'arc'?"),
        (KINDS, TrainingChoice(by="split"), "no run is left to judge by"),
    ],
)
def test_a_division_that_cannot_be_made_is_one_clear_line(
    dataset: Dataset, kinds: dict[str, tuple[str, ...]], rule: TrainingChoice, words: str
) -> None:
    with refused(OmnibenchError, words, start="robot two: "):
        divided(dataset, rule, kinds=kinds)


@pytest.mark.parametrize("rule", [TrainingChoice(leave_out="session"), TrainingChoice(leave_out="kind")], ids=str)
def test_a_copy_of_a_judged_run_does_not_train_for_it(dataset: Dataset, rule: TrainingChoice) -> None:
    runs = dataset.trajectories
    copies = [replace(run, id=f"arc_copy_{run.id}", session="another") for run in runs if run.id.startswith("line_0")]
    copied = make_dataset("copied", DIFFERENTIAL, dataset.sample_period, [*runs, *copies])
    for training in divided(copied, rule).values():
        for fold in training.folds:
            trained = {run.fingerprint for run in fold.training}
            judging = {copied.trajectories[index].fingerprint for each in fold.judged.values() for index in each}
            assert not trained & judging


def test_a_learning_curve_ends_where_the_runs_do(dataset: Dataset) -> None:
    rule = TrainingChoice(by="kind", kinds=("arc",), runs_per_command=(1, 6, 50))
    assert list(divided(dataset, rule)) == ["arc, 1 run a command", "arc, 6 runs a command"]


def test_runs_without_sessions_are_not_divided_by_them(dataset: Dataset) -> None:
    runs = [replace(run, session=None) for run in dataset.trajectories]
    nameless = make_dataset("nameless", DIFFERENTIAL, dataset.sample_period, runs)
    with pytest.raises(DataError, match="some runs name no session"):
        divided(nameless, TrainingChoice(by="session"))


@pytest.fixture
def runs(dataset: Dataset) -> tuple[Trajectory, ...]:
    return dataset.trajectories


def changes(runs: tuple[Trajectory, ...], regime: RegimeChoice) -> np.ndarray:
    """Changes (K, 3) of all poses."""
    worse = in_regime(runs, regime, 1)
    return np.concatenate([after.poses - before.poses for before, after in zip(runs, worse, strict=True)])


def test_as_recorded_nothing_changes(runs: tuple[Trajectory, ...]) -> None:
    assert all(after is before for before, after in zip(runs, in_regime(runs, RegimeChoice(), 1), strict=True))


def test_noise_has_the_deviations_that_are_said(runs: tuple[Trajectory, ...]) -> None:
    moved = changes(runs, RegimeChoice(noise_position=0.02, noise_heading_deg=2.0))
    assert moved.std(axis=0) == pytest.approx([0.02, 0.02, np.radians(2.0)], rel=0.25)


def test_outliers_are_so_many_and_so_far_and_keep_their_headings(runs: tuple[Trajectory, ...]) -> None:
    moved = changes(runs, RegimeChoice(outlier_share=0.25, outlier_size=1.0))
    far = np.hypot(moved[:, 0], moved[:, 1])
    assert set(np.round(far, 12)) == {0.0, 1.0}
    assert (far > 0).mean() == pytest.approx(0.25, abs=0.1)
    assert not moved[:, 2].any()


def test_a_late_clock_shows_where_the_robot_was_before(runs: tuple[Trajectory, ...]) -> None:
    run = runs[0]
    (late,) = in_regime([run], RegimeChoice(clock_offset=0.2), 1)
    speed = np.hypot(*np.diff(run.poses[:, :2], axis=0).T).mean() / np.diff(run.pose_times).mean()
    behind = np.hypot(*(late.poses - run.poses)[1:-1, :2].T) / speed
    assert behind == pytest.approx(behind.mean(), rel=0.2)
    assert 0 < behind.mean() < 1.0


def test_chance_hangs_on_the_seed_and_on_the_run_not_on_its_place(runs: tuple[Trajectory, ...]) -> None:
    regime = RegimeChoice(noise_position=0.02)
    whole, part = in_regime(runs, regime, 1), in_regime(runs[5:], regime, 1)
    assert np.array_equal(whole[5].poses, part[0].poses)
    assert not np.array_equal(whole[5].poses, in_regime(runs, regime, 2)[5].poses)


def test_fewer_runs_are_the_first_of_each_command(runs: tuple[Trajectory, ...]) -> None:
    kept = in_regime(runs, RegimeChoice(runs_per_command=1), 1)
    assert len(kept) == len({run.command for run in runs})
    assert {run.repetition for run in kept} == {1}
