"""Studies of calibrators on robots: their config, trainings and ranks."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from commands import Command, refused, run_here, summary, write_plugin
from sample_robots import DIFFERENTIAL
from studied import robot_dataset, write_study

from omnibench.compare.config import RegimeChoice, RobotChoice, TrainingChoice
from omnibench.compare.plan import Training, divide, in_regime
from omnibench.compare.ratios import Pairs, cell_ratio
from omnibench.compare.result import MEASURES, Cell, CellKey, MethodInCell
from omnibench.compare.statistics import profiles, ranking
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import DataError, OmnibenchError

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
    config["robots"]["two"]["trainings"] = ["kind", {"by": "session", "kinds": ["arc"]}, curve]
    config["robots"]["lost"] = {"path": "lost"}
    config["regimes"] = {"noise": {"noise_position": 0.05, "trainings": ["arc"]}}


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
    assert set(noisy["training"]) == {"arc"}
    recorded = studied.rows(regime="as recorded", method="default", robot="two", training="arc")
    assert noisy["cost"].sum() > recorded.filter(~pl.col("fitted"))["cost"].sum()


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
        ({"seeds": [-1]}, "seeds"),
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


# Which runs train and which judge, and training runs made worse.

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


# Intervals of ratios of errors, ranks, critical differences and performance profiles.


def cell(**errors: float | None) -> Cell:
    """A cell in which each method has one error; None: no answer."""

    def of(value: float) -> dict[str, np.ndarray]:
        return dict.fromkeys(MEASURES, np.array([value]))

    methods = {
        name: MethodInCell(
            name, "other", 1, {}, "", None if value is None else of(value), 0.0, "", int(value is not None)
        )
        for name, value in errors.items()
    }
    pairs = Pairs(np.zeros(1, dtype=int), np.zeros(1, dtype=int), (None,), (None,))
    return Cell(CellKey("robot", "a", "as recorded", "b", False), pairs, of(1.0), methods)  # type: ignore[arg-type]


def test_the_critical_difference_is_that_of_demsars_tables() -> None:
    """Demsar 2006: q is 2.343 for three methods, so CD = 2.343 sqrt(3 * 4 / (6 * 10)) for ten data sets."""
    ranked = ranking([cell(a=1.0, b=2.0, c=3.0)] * 10, ("a", "b", "c"))
    assert ranked.critical_difference == pytest.approx(2.343 * np.sqrt(12 / 60), rel=1e-3)
    assert ranked.methods == ("a", "b", "c")
    assert ranked.ranks == pytest.approx([1.0, 2.0, 3.0])
    assert ranked.groups == ((0, 1), (1, 2))


def test_a_method_without_an_answer_in_one_cell_has_no_rank_but_a_profile() -> None:
    cells = [cell(a=1.0, b=2.0, c=4.0, d=None), cell(a=2.0, b=1.0, c=4.0, d=0.5)]
    ranked = ranking(cells, ("a", "b", "c", "d"))
    assert set(ranked.methods) == {"a", "b", "c"}
    shares = profiles(cells, ("a", "d"), np.array([1.0, 2.0, 100.0]))
    assert {name: share.tolist() for name, share in shares.items()} == {"a": [0.5, 0.5, 1.0], "d": [0.5, 0.5, 0.5]}


def test_two_methods_have_no_ranks() -> None:
    assert ranking([cell(a=1.0, b=2.0)] * 5, ("a", "b")) is None


def pairs(sessions: int, runs_each: int, folds: int = 1, trained: bool = False) -> Pairs:
    """Each of ``folds`` calibrations judged on all runs of all sessions; trained: the folds are other sessions."""
    runs = np.tile(np.arange(sessions * runs_each), folds)
    of_fold = np.repeat(np.arange(folds), sessions * runs_each)
    return Pairs(
        of_fold,
        runs,
        tuple(f"trained {fold}" if trained else None for fold in of_fold),
        tuple(f"judged {run // runs_each}" for run in runs),
    )


def test_intervals_hold_the_true_ratio_as_often_as_they_say() -> None:
    rng = np.random.default_rng(5)
    judged, trained, held = 8, 6, 0
    cell = pairs(judged, 4, trained, trained=True)
    day, fold = np.unique(cell.judged_in, return_inverse=True)[1], cell.folds
    studies = 400
    for _ in range(studies):
        base = np.exp(rng.normal(0.0, 0.3, judged))[day]
        effect = rng.normal(0.0, 0.2, judged)[day] + rng.normal(0.0, 0.2, trained)[fold]
        errors = 0.8 * base * np.exp(effect - 0.04) * np.exp(rng.normal(0.0, 0.1, len(base)))
        held += cell_ratio(errors, base, cell, 1).alone.holds(0.8 * np.exp(0.005))
    assert 0.92 <= held / studies <= 0.99


def test_a_family_of_cells_has_wider_intervals() -> None:
    rng = np.random.default_rng(1)
    cell = pairs(6, 3)
    errors, others = rng.uniform(0.5, 1.5, 18), rng.uniform(0.5, 1.5, 18)
    ratio = cell_ratio(errors, others, cell, 30)
    assert ratio.in_family.known[0] < ratio.alone.known[0] < ratio.value < ratio.alone.known[1]


def test_two_sessions_give_an_interval_by_runs() -> None:
    rng = np.random.default_rng(1)
    ratio = cell_ratio(rng.uniform(0.5, 1.5, 20), rng.uniform(0.5, 1.5, 20), pairs(2, 10), 1)
    assert (ratio.unit, ratio.units) == ("run", "20 runs")


def test_two_runs_give_no_interval() -> None:
    ratio = cell_ratio(np.array([1.0, 2.0]), np.array([2.0, 3.0]), pairs(1, 2), 1)
    assert ratio.alone.known is None
    assert ratio.verdict == "undecided"


def test_equal_errors_are_no_difference() -> None:
    errors = np.linspace(1.0, 2.0, 12)
    ratio = cell_ratio(errors, errors, pairs(4, 3), 5)
    assert ratio.alone.known == (1.0, 1.0)
    assert ratio.verdict == "undecided"


@pytest.mark.parametrize(("share", "verdict"), [(0.5, "better"), (2.0, "worse")])
def test_a_clear_difference_is_told_whatever_the_sessions_scale(share: float, verdict: str) -> None:
    others = np.repeat([1.0, 10.0, 0.1, 4.0], 5)
    rng = np.random.default_rng(2)
    assert cell_ratio(share * others * rng.uniform(0.98, 1.02, 20), others, pairs(4, 5), 10).verdict == verdict
