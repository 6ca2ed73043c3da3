"""Scores of a comparison: costs, statistics, losses and certificates."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import compared_here, flower, prepare, refused, search, small, summary, write_plugin
from contamination import with_jumps
from numpy.typing import NDArray
from report_page import on_terminal
from report_samples import page, run, usual

from omnibench.compare.config import Bootstrap, CertificateChoice, CompareConfig, effective_config
from omnibench.compare.plan import PlannedFit, load_robots, plan_fits
from omnibench.compare.report.comparison_view import ComparisonView
from omnibench.compare.result import ComparisonResult, EntryStatistics, RunRecord, ScoredFit, SplitScore
from omnibench.compare.score import SplitScorer, mean_errors_of, score_fits
from omnibench.compare.statistics import NEGLIGIBLE_SHARE, entry_statistics
from omnibench.data.dataset import Dataset, Split, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import PluginError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluate import evaluate
from omnibench.fit.intervals import Clusters
from omnibench.registry import calibrators, costs, effects
from omnibench.report.terminal import print_result
from omnibench.robot.calibration import EffectTerm, ModelExtension, read_calibration
from omnibench.robot.kinematics import Array, Robot, published_matrix
from omnibench.robot.model import OdometryModel

TRUE = published_matrix("palacin2023_eq8")
WIDE = {"lower": [[-1.0] * 3] * 3, "upper": [[1.0] * 3] * 3}
WIDER = {"lower": [[-2.0] * 3] * 3, "upper": [[2.0] * 3] * 3}


def records(
    entries: Sequence[dict[str, Any] | str],
    shares: Sequence[float | None],
    outcome: Outcome = Outcome.CONVERGED,
    **changes: Any,
) -> dict[str, RunRecord]:
    """Rows of entries whose answers lie a share of the way from the true matrix to the design; None: no answer."""
    config = effective_config(CompareConfig.model_validate(small(calibrators=entries, **changes)))
    plan = plan_fits(config, load_robots(config)[0])
    results = [answer(run, share, outcome) for run, share in zip(plan, shares, strict=True)]
    return {run.record.label: run.record for run in score_fits(config, plan, results)[0]}


def answer(run: PlannedFit, share: float | None, outcome: Outcome) -> RunResult:
    if share is None:
        return RunResult(Outcome.FAILED, "because", None, None, None, 0, 0.0, ())
    matrix = TRUE + share * (run.dataset.robot.inverse_kinematic_matrix - TRUE)
    return RunResult(outcome, "so", matrix.ravel(), matrix, 0.0, 1, 0.1, ())


def test_gap_and_improvement_are_shares_of_cost_above_the_optimum_and_below_the_design() -> None:
    rows = records(["closed_form", "crs"], (0.0, 0.1))
    assert rows["closed_form"].gap == 0.0
    assert rows["crs"].gap == pytest.approx(rows["crs"].train_cost / rows["closed_form"].train_cost - 1)
    assert rows["crs"].train_improvement == pytest.approx(
        1 - rows["crs"].train_cost / rows["crs"].theoretical_train_cost
    )


def test_neither_gap_nor_improvement_is_measured_from_a_cost_without_error() -> None:
    exact = {"flower": {"simulate": flower(noise={}, validation=None)}}
    rows = records(["closed_form", "crs"], (0.0, 0.1), datasets=exact)
    assert rows["closed_form"].train_cost == pytest.approx(0.0, abs=1e-12)
    assert (rows["closed_form"].gap, rows["crs"].gap) == (None, None)
    truth = {"matrix": Robot.model_validate(flower()["robot"]).inverse_kinematic_matrix.tolist()}
    as_designed = {"flower": {"simulate": flower(noise={}, truth=truth, validation=None)}}
    (row,) = records(["crs"], (0.0,), datasets=as_designed).values()
    assert (row.theoretical_train_cost, row.train_improvement) == (pytest.approx(0.0, abs=1e-12), None)


def entry(name: str, box: Any) -> dict[str, Any]:
    return {"name": name, "box": box}


@pytest.mark.parametrize(
    ("entries", "shares", "gap_boxes"),
    [
        (["closed_form", "crs"], (0.0, 0.1), ("row", "row")),
        (["closed_form", "parametric"], (0.0, 0.1), ("row", "row")),  # the box contains the geometry's matrix
        ([entry("closed_form", "paper"), "crs"], (0.0, 0.1), ("paper", None)),  # of another box
        (["closed_form", "crs"], (None, 0.1), (None, None)),  # no optimum was found
        (
            [entry("closed_form", WIDE), entry("crs", WIDER), entry("isres", WIDE)],
            (0.0, 0.1, 0.1),
            ("custom", None, "custom"),
        ),
        # An answer without a box: the design is in the paper's, the true matrix outside it.
        (
            [entry("closed_form", "paper"), "closed_form", "theoretical", "published"],
            (0.5, 0.0, 1.0, 0.0),
            ("paper", "row", "paper", "row"),
        ),
    ],
)
def test_a_gap_is_measured_from_the_optimum_of_the_same_box_or_of_one_that_contains_the_answer(
    entries: list[Any], shares: tuple[float | None, ...], gap_boxes: tuple[str | None, ...]
) -> None:
    rows = records(entries, shares).values()
    assert tuple(row.gap_box for row in rows) == gap_boxes
    assert all((row.gap is None) == (row.gap_box is None) for row in rows)


def test_no_gap_is_measured_against_an_optimum_that_was_not_reached() -> None:
    rows = records(["closed_form", "crs"], (0.0, 0.1), Outcome.BUDGET)
    assert [row.gap for row in rows.values()] == [None, None]


def test_final_errors_are_mean_distances_and_mean_absolute_headings() -> None:
    errors = np.array([[3.0, 4.0, -0.1], [0.0, 0.0, 0.3]])
    assert mean_errors_of(errors) == pytest.approx((2.5, 0.2))


class Mine(Cost):
    name = "mine"

    def __init__(self, combined: Callable[[int], Array]) -> None:
        super().__init__(None)
        self.combined = combined

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:  # noqa: ARG002
        return self.combined(len(errors))


def raising(_: int) -> Array:
    raise ZeroDivisionError("no\nway")


@pytest.mark.parametrize(
    ("combined", "complaint"),
    [
        (raising, "'mine' raised ZeroDivisionError: no way"),
        (lambda count: np.full(count, np.nan), "'mine' gave NaN or infinity"),
        (lambda _: np.array(3.0), "'mine' gave an array of shape ()"),
    ],
)
def test_a_cost_that_is_no_cost_is_one_line(combined: Callable[[int], Array], complaint: str) -> None:
    dataset = load_dataset(prepare().data)
    scorer = SplitScorer(dataset.split("train"), Mine(combined), "arc")
    with refused(PluginError, complaint):
        scorer.score(TRUE)


ROOT_MEAN_SQUARE = """
from omnibench.fit.cost import Cost
from omnibench.registry import costs

@costs.register("root_mean_square")
class RootMeanSquare(Cost):
    "Root of the mean square."

    def combine(self, errors, trajectory):
        return np.sqrt(np.square(errors).sum(axis=-1).mean(axis=-1))
"""


def test_a_cost_that_is_no_mean_over_trajectories_is_warned_of(tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "root_mean_square", ROOT_MEAN_SQUARE)
    result = compared_here(tmp_path / "out", plugins=[plugins], cost="root_mean_square", calibrators=["theoretical"])
    assert [warning for warning in result.warnings if "the cost is no mean over trajectories" in warning]


def test_what_the_runs_do_not_identify_is_warned_of_for_everything_that_is_fitted(tmp_path: Path) -> None:
    straight = flower(commands={"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [0.0]})
    entries = ["theoretical", "closed_form"]
    result = compared_here(tmp_path / "out", datasets={"flower": {"simulate": straight}}, calibrators=entries)
    (warning,) = result.warnings
    assert warning.startswith("data set flower, fit of the matrix:")
    assert "(turning on the spot)" in warning


# Answers with effects beside the matrix

DRIFTING = """
import numpy as np
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.registry import calibrators
from omnibench.robot.calibration import EffectTerm, ModelExtension, Noise

@calibrators.register("drifting")
class Drifting(Calibrator):
    "The start, with a drift of the heading."

    stochastic = False
    extends = True

    def calibrate(self, problem):
        term = EffectTerm(name="heading_drift", parameters={"b": 0.03})
        covariance = np.diag([1e-8] * problem.size + [1e-4])
        extension = ModelExtension(
            effects=(term,),
            driven=((0.2, 0.0, 0.0),),
            plain=tuple(map(tuple, problem.matrix(problem.start).tolist())),
            covariance=tuple(map(tuple, covariance.tolist())),
        )
        return Solution(problem.start, "so", noise=Noise(walk_heading=0.01), extension=extension)
"""


@pytest.mark.parametrize("name", ["final_pose", "trajectory"])
def test_a_model_without_effects_has_the_score_of_its_matrix(name: str) -> None:
    dataset = load_dataset(prepare().data)
    runs, matrix = dataset.split("train"), published_matrix("palacin2023_eq8")
    scorer, model = SplitScorer(runs, costs.create(name), "arc"), OdometryModel(dataset.robot, matrix, "arc")
    of_matrix, of_model = scorer.score(matrix), scorer.score(model)
    assert of_model.cost == pytest.approx(of_matrix.cost, rel=1e-9)
    np.testing.assert_allclose(of_model.costs, of_matrix.costs, rtol=1e-9)
    np.testing.assert_allclose(of_model.errors, of_matrix.errors, atol=1e-12)


def test_row_and_file_are_of_the_model_with_its_effects(tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "drifting", DRIFTING)
    result = compared_here(tmp_path / "out", plugins=[plugins], calibrators=["theoretical", "closed_form", "drifting"])
    rows = {run.record.label: run.record for run in result.runs}
    file = read_calibration(tmp_path / "out" / "calibrations" / "flower-drifting.yaml")
    (term,) = file.effects
    assert (term.name, dict(term.parameters)) == ("heading_drift", {"b": 0.03})
    assert file.plain is not None
    assert file.driven is not None
    assert np.array(file.covariance)[-1, -1] == 1e-4
    assert file.noise is not None
    found = evaluate(file, result.datasets["flower"]).splits["train"]
    assert rows["drifting"].train_cost == pytest.approx(found.cost, rel=1e-9)
    assert rows["drifting"].train_position_m == pytest.approx(found.position_mean_m, rel=1e-9)
    assert rows["drifting"].train_cost != pytest.approx(rows["theoretical"].train_cost, rel=1e-3)
    assert rows["drifting"].gap is None
    assert rows["theoretical"].gap is not None


def test_an_effect_that_does_not_act_on_a_run_is_a_failed_row() -> None:
    config = effective_config(CompareConfig.model_validate(small(calibrators=["theoretical"])))
    (run,) = plan_fits(config, load_robots(config)[0])
    result = run_calibrator(calibrators.create("theoretical"), run.problem())
    robot = run.dataset.robot
    names = [parameter.name for parameter in effects.create("wheel_eccentricity").parameters(robot)]
    term = EffectTerm(name="wheel_eccentricity", parameters=dict.fromkeys(names, 0.01))
    bare = replace(run.dataset, trajectories=tuple(replace(each, angles=None) for each in run.training_runs))
    extended = replace(result, extension=ModelExtension(effects=(term,)))
    (scored,), _ = score_fits(config, [replace(run, robot=replace(run.robot, dataset=bare))], [extended])
    assert scored.record.outcome == Outcome.FAILED
    assert "effect 'wheel_eccentricity' needs" in scored.record.reason


# Statistics of entries: what intervals cover, what is paired, what is practically equal.

BOOTSTRAP = Bootstrap(resamples=1000, seed=3)


def scored(
    label: str,
    train: Array | None,
    validation: Array | None = None,
    *,
    seed: int = 1,
    dataset: str = "flower",
    theoretical: Array | None = None,
    gap: float | None = None,
    evaluations: int = 10,
) -> ScoredFit:
    """A run whose trajectories have these costs; None: no answer."""
    design = np.ones(8 if train is None else len(train)) if theoretical is None else theoretical
    answered = Outcome.FAILED if train is None else Outcome.CONVERGED
    names = {"dataset": dataset, "label": label, "calibrator": "crs", "parameterisation": "matrix", "box": "row"}
    counts = {"seed": seed, "evaluations": evaluations, "seconds": 1.0}
    measures = {
        "train_cost": None if train is None else float(train.mean()),
        "validation_cost": None if validation is None else float(validation.mean()),
        "theoretical_train_cost": float(design.mean()),
        "theoretical_validation_cost": None if validation is None else float(design.mean()),
        "gap": gap,
    }
    others = {"options": {}, "outcome": answered, "reason": "", "at_bounds": (), "held": ()}
    record = RunRecord(**dict.fromkeys(RunRecord.model_fields) | names | counts | measures | others)
    costs: dict[Split, Array | None] = {"train": train, "validation": validation}
    scores = {split: split_score(values) for split, values in costs.items() if values is not None}
    designs: dict[Split, SplitScore] = {"train": split_score(design)}
    if validation is not None:
        designs["validation"] = split_score(design)
    unused: Any = None  # statistics are made of the row and the scores
    return ScoredFit(unused, unused, None, record, scores, designs)


def split_score(costs: Array) -> SplitScore:
    units = Clusters("run", np.arange(len(costs)))
    return SplitScore(float(costs.mean()), costs, np.zeros((len(costs), 3)), units, SumOfNorms.rounding)


def of(runs: list[ScoredFit], bootstrap: Bootstrap = BOOTSTRAP) -> dict[str, EntryStatistics]:
    return {entry.label: entry for entry in entry_statistics(runs, bootstrap)}


def test_the_same_seed_draws_the_same_intervals() -> None:
    runs = [scored("a", np.random.default_rng(6).normal(5.0, 1.0, 40))]
    assert entry_statistics(runs, BOOTSTRAP) == entry_statistics(runs, BOOTSTRAP)
    assert entry_statistics(runs, BOOTSTRAP) != entry_statistics(runs, Bootstrap(resamples=1000, seed=4))


def test_an_interval_is_as_wide_as_the_standard_error_says() -> None:
    costs = np.random.default_rng(1).normal(5.0, 1.0, 400)
    entry = of([scored("a", costs)], Bootstrap(resamples=20_000))["a"]
    train = entry.costs["train"]
    error = costs.std(ddof=1) / np.sqrt(400)
    assert train.value == pytest.approx(costs.mean())
    assert train.low == pytest.approx(costs.mean() - 1.96 * error, abs=0.05 * error)
    assert train.high == pytest.approx(costs.mean() + 1.96 * error, abs=0.05 * error)


def test_a_difference_is_paired_by_trajectory() -> None:
    rng = np.random.default_rng(2)
    hard_and_easy = rng.uniform(1.0, 100.0, 50)
    entries = of([scored("best", hard_and_easy), scored("other", hard_and_easy + rng.normal(0.5, 0.05, 50))])
    difference = entries["other"].difference
    assert difference.value == pytest.approx(0.5, abs=0.05)
    assert difference.high - difference.low < 0.1  # unpaired it would be about 20
    assert entries["other"].practically_equal is False


def test_the_best_entry_has_the_lowest_validation_cost_not_the_lowest_training_cost() -> None:
    entries = of([scored("a", np.full(8, 1.0), np.full(8, 3.0)), scored("b", np.full(8, 2.0), np.full(8, 2.0))])
    assert (entries["a"].is_best, entries["b"].is_best) == (False, True)
    assert entries["a"].difference.value == pytest.approx(1.0)
    best = entries["b"].difference
    assert (best.value, best.low, best.high) == (0.0, 0.0, 0.0)
    assert entries["b"].practically_equal is True


def test_between_entries_within_the_noise_the_training_cost_decides_which_is_best() -> None:
    noise = np.random.default_rng(0).normal(size=100)
    lowest = scored("lowest", np.full(100, 2.0), 2 + 0.1 * noise)
    level = scored("level", np.full(100, 1.0), 2 + 0.1 * noise + 1e-4)
    worse = scored("worse", np.full(100, 0.5), 3 + 0.1 * noise)
    entries = of([lowest, level, worse])
    assert [label for label, entry in entries.items() if entry.is_best] == ["level"]
    assert (entries["lowest"].practically_equal, entries["worse"].practically_equal) == (True, False)


def test_without_validation_data_the_training_cost_decides_for_every_data_set_apart() -> None:
    runs = [scored("a", np.full(8, cost), dataset=name) for name, cost in (("one", 1.0), ("two", 5.0))]
    runs += [scored("b", np.full(8, cost), dataset=name) for name, cost in (("one", 2.0), ("two", 4.0))]
    best = {(entry.dataset, entry.label) for entry in entry_statistics(runs, BOOTSTRAP) if entry.is_best}
    assert best == {("one", "a"), ("two", "b")}


def test_a_difference_of_one_sign_everywhere_is_practically_equal_where_chance_explains_it() -> None:
    more = np.array([1e-4, 2e-4, 1e-4, 3e-4, 0.05])
    entries = of([scored("best", np.full(5, 1.0)), scored("other", 1.0 + more)])
    low, high = entries["other"].difference.known
    assert low < 0 < high < 0.1
    assert entries["other"].practically_equal is True


def test_a_certain_difference_is_practically_equal_below_a_tenth_of_the_standard_error_of_the_best() -> None:
    costs = np.random.default_rng(5).uniform(1.0, 2.0, 40)
    limit = NEGLIGIBLE_SHARE * costs.std(ddof=1) / np.sqrt(40)
    entries = of([scored("best", costs), scored("below", costs + 0.99 * limit), scored("above", costs + 1.01 * limit)])
    assert entries["below"].difference.low > 0  # the interval does not contain zero
    assert (entries["below"].practically_equal, entries["above"].practically_equal) == (True, False)


def test_the_median_and_the_spread_are_over_seeds() -> None:
    runs = [
        scored("a", np.full(8, cost), seed=seed, evaluations=10 * seed) for seed, cost in enumerate((5, 1, 3, 9, 2), 1)
    ]
    entry = of(runs)["a"]
    assert (entry.train_median, entry.train_spread, entry.evaluations_median) == (3.0, 3.0, 30.0)
    assert (entry.runs, entry.answers) == (5, 5)


@pytest.mark.parametrize(("costs", "seed"), [((5.0, 1.0, 3.0), 3), ((5.0, 1.0), 1)])
def test_the_typical_run_has_the_median_training_cost_and_of_two_the_worse(costs: tuple[float, ...], seed: int) -> None:
    entry = of([scored("a", np.full(8, cost), seed=seed) for seed, cost in enumerate(costs, 1)])["a"]
    assert entry.typical.record.seed == seed


def test_runs_without_an_answer_are_counted_and_left_out() -> None:
    entry = of([scored("a", None, seed=1), scored("a", np.full(8, 2.0), seed=2)])["a"]
    assert (entry.runs, entry.answers, entry.train_median) == (2, 1, 2.0)
    assert entry.typical.record.seed == 2


def test_an_entry_without_any_answer_has_no_statistics_and_is_never_best() -> None:
    entry = of([scored("a", None), scored("b", np.full(8, 2.0))])["a"]
    assert (entry.typical, entry.costs.get("train"), entry.train_median, entry.difference) == (None, None, None, None)
    assert (entry.practically_equal, entry.is_best) == (None, False)


def test_the_gap_of_an_entry_is_the_median_of_its_runs() -> None:
    runs = [scored("a", np.full(8, 1.0), seed=seed, gap=gap) for seed, gap in enumerate((0.3, None, 0.1, 0.2))]
    assert of(runs)["a"].gap_median == pytest.approx(0.2)


@pytest.mark.parametrize("number", [1, 2])
def test_one_or_two_runs_have_no_interval_and_nothing_is_said_to_differ(number: int) -> None:
    runs = [
        scored(name, np.full(number, cost), theoretical=np.full(number, 4.0)) for name, cost in (("a", 2), ("b", 3))
    ]
    entries = of(runs)
    improvement, difference = entries["a"].improvements["train"], entries["b"].difference
    assert (entries["a"].costs["train"].value, entries["a"].costs["train"].known) == (2.0, None)
    assert (improvement.value, improvement.known) == (0.5, None)
    assert (difference.known, entries["b"].practically_equal) == (None, None)


# Comparisons with a loss that bounds the influence of reference poses that are far off.

_SHARE, _OFF = 0.1, 1.0  # of the poses; m


@pytest.fixture(scope="module")
def jumping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small recordings, a tenth of whose training poses are a metre off, and comparisons of them beside them."""
    folder = tmp_path_factory.mktemp("jumping")
    dataset = load_dataset(prepare().data)
    spoilt = with_jumps(dataset.split("train"), _SHARE, _OFF, np.random.default_rng(3))
    runs = [*spoilt, *dataset.split("validation")]
    save_dataset(make_dataset("jumping", dataset.robot, dataset.sample_period, runs, simulated=True), folder / "data")
    return folder


def compared(data: Path, folder: Path, **changes: object) -> ComparisonResult:
    sets, entries = {"jumping": {"path": str(data)}}, ["theoretical", "closed_form"]
    return compared_here(folder / str(changes["loss"]), datasets=sets, calibrators=entries, **changes)


@pytest.fixture(scope="module")
def squares(jumping: Path) -> ComparisonResult:
    return compared(jumping / "data", jumping, loss="squares")


@pytest.fixture(scope="module")
def huber(jumping: Path) -> ComparisonResult:
    return compared(jumping / "data", jumping, loss="huber")


def far_ends(result: ComparisonResult) -> list[str]:
    """Warnings of runs whose ends were taken from other poses."""
    return [warning for warning in result.warnings if "beside it say" in warning]


def test_a_robust_loss_is_better_without_jumps_and_is_said(squares: ComparisonResult, huber: ComparisonResult) -> None:
    robust, other = (result.runs[1].record.validation_cost for result in (huber, squares))
    assert robust < other
    assert "loss" not in summary(squares.output)
    assert summary(huber.output)["loss"] == "huber"
    assert huber.config.objective == "final_pose, loss huber"


def test_answer_and_warning_are_those_of_calibrate(squares: ComparisonResult, huber: ComparisonResult) -> None:
    dataset: Dataset = huber.datasets["jumping"]
    alone = calibrate(dataset, "closed_form", loss="huber", cost="final_pose")
    np.testing.assert_array_equal(np.array(huber.runs[1].record.matrix), alone.calibration.matrix)
    (of_calibrate,) = (warning for warning in alone.warnings if "beside it say" in warning)
    assert far_ends(huber) == [f"data set jumping: {of_calibrate}"]
    assert far_ends(squares) == []


def test_nothing_is_proven_of_a_robust_loss_and_without_jumps_no_end_is_moved(tmp_path: Path) -> None:
    result = compared(prepare().data, tmp_path, loss="student_t", certificate={"gap": 0.5, "seconds": 5})
    assert result.certificates == ()
    assert far_ends(result) == []


# A comparison proves what no optimiser can beat, and says of every run how much it could gain at most.

PROVEN = {"gap": 0.05, "seconds": 1e9, "parts": 2000}
ENTRIES = ["theoretical", "closed_form", {"name": "closed_form", "box": "paper"}, search(), "parametric"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> ComparisonResult:
    return compared_here(tmp_path_factory.mktemp("proven") / "out", calibrators=ENTRIES, certificate=PROVEN)


def test_every_box_of_matrices_has_its_bound_and_no_run_is_below_it(result: ComparisonResult) -> None:
    assert [certificate.box for certificate in result.certificates] == ["row", "paper"]
    for certificate in result.certificates:
        assert certificate.finished
        assert 0 <= certificate.gap <= 0.05
        assert certificate.lower_bound <= certificate.best_cost
    bounds = {certificate.box: certificate.lower_bound for certificate in result.certificates}
    for record in (done.record for done in result.runs):
        assert record.proven_gap is not None  # of a geometry in a box that contains its matrix
        if record.box in bounds:
            assert record.train_cost >= bounds[record.box]
            assert record.proven_gap == pytest.approx(1 - bounds[record.box] / record.train_cost)


def test_the_exact_optimum_has_little_to_gain_and_a_poor_search_much(result: ComparisonResult) -> None:
    gaps = {done.record.label: done.record.proven_gap or 0.0 for done in result.runs}
    assert gaps["closed_form"] <= 0.05
    assert gaps["theoretical"] > 0.5
    assert gaps["search"] > gaps["closed_form"]


def test_terminal_and_report_say_what_is_proven(result: ComparisonResult, tmp_path: Path) -> None:
    assert "What no optimiser can beat" in on_terminal(print_result, ComparisonView(result, everything=True), width=200)
    text = page(result, tmp_path).text
    assert "What no optimiser can beat" in text
    assert "proven: ≤" in text


def test_a_number_of_parts_ends_a_proof_whatever_the_machine(result: ComparisonResult) -> None:
    config = result.config.model_copy(update={"certificate": CertificateChoice(gap=1e-9, seconds=1e9, parts=5)})
    (found,) = run(config.model_copy(update={"calibrators": config.calibrators[1:2]})).certificates
    assert (found.parts, found.finished) == (5, False)


def test_nothing_is_proven_where_nobody_asks_but_by_default() -> None:
    assert usual().certificates == ()
    assert all(done.record.proven_gap is None for done in usual().runs)
    content = {name: value for name, value in small().items() if name != "certificate"}
    assert CompareConfig.model_validate(content).certificate is not None
