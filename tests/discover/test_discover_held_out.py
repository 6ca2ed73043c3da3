"""Cross-validation, and gaps between held-out errors and what repetitions allow, from residuals that are known."""

from dataclasses import replace

import numpy as np
import pytest
from extended_samples import FORWARD, MATRIX, SECONDS, SIDEWAYS, TURN, extended_of, run_of
from screening_samples import FIRST, SECOND, screening

from omnibench.data.dataset import Trajectory
from omnibench.discover.held_out import (
    ValidationRuns,
    compare_held_out,
    errors_of_repetitions,
    extrapolations_of,
    floor_of,
    folds_of_commands,
    folds_of_kinds,
    folds_of_repetitions,
    gap_between,
    held_out_chi_square,
    is_confirmed,
    kinds_of_runs,
    random_folds_of_repetitions,
    training_gap,
    values_of_other_folds,
)
from omnibench.fit.trajectory_fit import Whitened


def runs_of(*commands: str | None, session: str = "s1") -> list[Trajectory]:
    nothing = np.zeros((1, 3))
    return [
        Trajectory(f"run {number}", "train", np.ones(1), nothing, np.zeros(1), nothing, command=name, session=session)
        for number, name in enumerate(commands)
    ]


def constants(*values: float) -> Whitened:
    """Runs of one residual each, with one column of ones: what is fitted is their mean."""
    residuals = tuple(np.array([value]) for value in values)
    columns = tuple(np.ones((1, 1)) for _ in values)
    return Whitened(residuals, columns, np.array([[float(len(values))]]), np.array(values)[:, None])


def test_repetitions_of_a_command_go_to_different_folds() -> None:
    folds = folds_of_repetitions(runs_of(*5 * ("forward",), *5 * ("turn",)))
    assert folds.tolist() == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4]
    assert folds_of_repetitions(runs_of(*"aabbcc")).tolist() == [0, 1, 1, 2, 2, 3]  # few begin one after the other


def test_at_random_repetitions_still_go_to_different_folds_and_differ_by_the_generator() -> None:
    runs = runs_of(*10 * ("forward",), *2 * ("turn",))
    several = [random_folds_of_repetitions(runs, np.random.default_rng(seed)) for seed in range(5)]
    assert all(sorted(folds[:10]) == sorted(2 * [0, 1, 2, 3, 4]) for folds in several)
    assert all(folds[10] != folds[11] for folds in several)
    assert len({tuple(folds) for folds in several}) > 1
    np.testing.assert_array_equal(several[0], random_folds_of_repetitions(runs, np.random.default_rng(0)))


def test_all_runs_of_a_command_are_held_out_together_and_runs_without_one_by_themselves() -> None:
    folds = folds_of_commands(runs_of("a", "b", "a", None, None))
    assert folds.tolist() == [0, 1, 0, 2, 3]


def test_a_command_and_those_like_it_are_held_out_together() -> None:
    runs = [run_of(FORWARD, "ahead"), run_of(SIDEWAYS, "aside"), run_of(1.01 * FORWARD, "a little faster"),
            run_of(TURN, "turn"), run_of(FORWARD, "ahead")]  # fmt: skip
    fit = extended_of(runs, [np.zeros((2, 3))] * 5).fit
    assert kinds_of_runs(fit).tolist() == [0, 1, 0, 2, 0]
    assert folds_of_kinds(fit).tolist() == [0, 1, 0, 2, 0]


def test_out_and_back_is_one_kind_of_motion_however_its_mean_scatters() -> None:
    there, back = np.tile(FORWARD, (20, 1)), np.tile(-FORWARD, (20, 1))
    rng = np.random.default_rng(0)
    runs = [replace(run_of(FORWARD, "to and fro"), rates=np.vstack([there, back]) + 0.01 * rng.standard_normal((40, 3)))
            for _ in range(20)]  # fmt: skip
    apart = [replace(run, command=None, id=str(number)) for number, run in enumerate(runs)]
    for recorded in (runs, apart):
        fit = extended_of(recorded, [np.zeros((2, 3))] * 20).fit
        assert set(kinds_of_runs(fit).tolist()) == {0}


def test_runs_of_one_fold_never_predict_each_other() -> None:
    values = values_of_other_folds(constants(1.0, 2.0, 6.0), [0], np.array([0, 0, 1]))
    assert values[:, 0].tolist() == pytest.approx([6.0, 6.0, 1.5])


def test_the_gain_of_a_column_is_the_fall_of_each_held_out_runs_squares() -> None:
    gains = held_out_chi_square(constants(1.0, 2.0, 6.0), [], [0], np.array([0, 1, 2]))
    assert gains.tolist() == pytest.approx([1 - 3**2, 4 - 1.5**2, 36 - 4.5**2])


def test_a_column_is_confirmed_if_held_out_runs_gain_by_two_standard_errors() -> None:
    given = screening({"heading_drift": FIRST, "floor_drift": SECOND}, {}, [0, 10, 0, 0, 0])
    assert is_confirmed(given.data, [0], [1], given.folds)
    assert not is_confirmed(given.data, [0], [2], given.folds)
    assert not is_confirmed(given.data, [0, 1], [1], given.folds)


RUNS = [
    run_of(rates, name, f"{name} {number}") for name, rates in (("go", FORWARD), ("turn", TURN)) for number in (1, 2)
]
NO_VALIDATION = ValidationRuns((), (), ())


def left(*finals: float) -> list[np.ndarray]:
    """Residuals along x alone, half of the final one at the middle of a run."""
    return [np.array([[final / 2, 0.0, 0.0], [final, 0.0, 0.0]]) for final in finals]


def test_the_share_that_is_closed_is_that_of_the_gap_to_the_floor() -> None:
    gap = gap_between("eq6", np.array([5.0, 5.0]), np.array([2.0, 2.0]), np.array([1.0, 1.0]))
    assert (gap.before, gap.after, gap.floor, gap.closed, gap.standard_error) == (5.0, 2.0, 1.0, 0.75, 0.0)


def test_of_a_gap_within_two_standard_errors_no_share_is_closed() -> None:
    before, floor = np.array([2.0, 4.0]), np.array([0.0, 2.0])  # 3 and 1, each with a variance of 1: an error of 1
    gap = gap_between("eq6", before, before / 2, floor)
    assert gap.standard_error == pytest.approx(1.0)
    assert gap.closed is None
    assert gap_between("eq6", before + 0.1, before, floor).closed == pytest.approx(0.1 / 2.1)


def test_without_repetitions_there_is_no_floor_and_nothing_is_closed() -> None:
    gap = gap_between("chi2", np.array([3.0, 5.0]), np.array([2.0, 2.0]), None)
    assert (gap.floor, gap.closed) == (None, None)
    assert gap.standard_error == pytest.approx(1 / np.sqrt(2))


def test_what_a_model_errs_less_than_is_no_floor() -> None:
    before, floor = np.full(4, 5.0), np.full(4, 3.0)
    gap = gap_between("eq6", before, np.full(4, 2.0), floor)
    assert (gap.floor, gap.closed) == (None, 1.0)
    assert gap_between("eq6", before, np.full(4, 3.5), floor).floor == 3.0


def test_where_all_runs_are_in_one_fold_nothing_is_held_out() -> None:
    model = extended_of(RUNS, left(4, 6, 4, 6))
    assert compare_held_out(model, model, NO_VALIDATION, np.zeros(4, dtype=np.intp)) == ()
    assert training_gap(model, model).before == 5.0


def test_a_model_with_nothing_to_fit_errs_by_its_residuals() -> None:
    errors = errors_of_repetitions(extended_of(RUNS, left(1, 3, 2, 2)), np.array([0, 1, 0, 1]))
    assert errors.finals[:, 0].tolist() == pytest.approx([1, 3, 2, 2])
    assert errors.chi2.tolist() == pytest.approx([1.25 / 6, 1.25 * 9 / 6, 1.25 * 4 / 6, 1.25 * 4 / 6])


def test_a_run_is_predicted_by_the_runs_of_the_other_folds_alone() -> None:
    slopes = [each[..., None] for each in left(1, 1, 1, 1)]  # one column, of which each run wants as much as it leaves
    errors = errors_of_repetitions(extended_of(RUNS, left(1, 3, 2, 4), slopes), np.array([0, 1, 0, 1]))
    assert errors.finals[:, 0].tolist() == pytest.approx([1 - 3.5, 3 - 1.5, 2 - 3.5, 4 - 1.5])


def test_the_floor_is_the_scatter_between_repetitions_as_one_prediction_errs_by_it() -> None:
    floor = floor_of(extended_of(RUNS, left(1, 3, 2, 2)).fit)
    assert sorted(floor.eq6.tolist()) == pytest.approx([0.0, np.sqrt(2)])  # 2 apart, over the root of 2
    assert floor_of(extended_of(RUNS[::2], left(1, 2)).fit) is None  # no command is repeated


def test_held_out_errors_are_means_of_both_models_over_the_runs() -> None:
    plain, better = extended_of(RUNS, left(4, 6, 4, 6)), extended_of(RUNS, left(1, 3, 1, 3))
    (held_out,) = compare_held_out(plain, better, NO_VALIDATION, np.array([0, 1, 0, 1]))
    assert (held_out.data, held_out.runs) == ("repetitions", 4)
    assert held_out.position_m == (5.0, 2.0)
    assert held_out.heading_rad == (0.0, 0.0)
    assert held_out.eq6.floor == pytest.approx(np.sqrt(2))
    assert held_out.eq6.closed == pytest.approx(3 / (5 - np.sqrt(2)))


def test_runs_of_the_validation_are_predicted_as_they_are() -> None:
    late = run_of(FORWARD, "go", "later", split="validation")
    late.poses[-1] += [0.3, 0.4, 0.1]
    model = extended_of(RUNS, left(1, 1, 1, 1))
    _, held_out = compare_held_out(model, model, ValidationRuns((late,), (), ()), np.array([0, 1, 0, 1]))
    assert held_out.data == "session"
    assert held_out.position_m == pytest.approx((0.5, 0.5))
    assert held_out.heading_rad == pytest.approx((0.1, 0.1))
    assert held_out.chi2.before == pytest.approx((0.09 + 0.16 + 0.01) / 6)


# Motions outside the training domain, and bounds on the predictions there

TRAINING = [run_of(FORWARD, "go", f"go {number}") for number in (1, 2)]
NOTHING = [np.zeros((2, 3)) for _ in TRAINING]
TURNED = [run_of(TURN, "turn", "turn 1", split="validation")]
RADIUS_95 = 2.45 / np.sqrt(2)  # of the circle that holds 95 % of errors whose mean square is 1


def test_a_command_that_the_training_drove_is_no_extrapolation() -> None:
    plain = extended_of(TRAINING, NOTHING)
    again = [run_of(1.05 * FORWARD, "a little faster", "again", split="validation")]
    assert extrapolations_of(again, plain, plain, [(1.0, plain)]) == ()


def test_a_command_that_the_training_never_drove_is_named_with_how_much_of_it_is_new() -> None:
    plain = extended_of(TRAINING, NOTHING)
    (found,) = extrapolations_of([*TURNED, *TRAINING], plain, plain, [(1.0, plain)])
    assert found.command == "turn"
    assert found.description.startswith("100 % of its time it drives what no training run drove, such as ")
    assert (found.before_m, found.after_m) == (0.0, 0.0)  # nothing is left, and all is known


def test_the_bound_follows_from_what_commands_that_were_held_out_left() -> None:
    plain = extended_of(TRAINING, [np.array([[0.0, 0.0, 0.0], [0.03, 0.04, 0.0]]) for _ in TRAINING])
    (found,) = extrapolations_of(TURNED, plain, plain, [(1.0, plain)])
    assert found.before_m == pytest.approx(RADIUS_95 * 0.05)


def test_the_bound_follows_from_what_the_matrix_is_known_to() -> None:
    covariance = np.zeros((9, 9))
    covariance[1, 1] = 0.001**2  # m12, the share of the second wheel in the motion along x, to 1 mm a rad
    sideways = [run_of(SIDEWAYS, "sideways", split="validation")]
    plain, unsure = extended_of(TRAINING, NOTHING), extended_of(TRAINING, NOTHING, covariance=covariance)
    (found,) = extrapolations_of(sideways, plain, unsure, [(1.0, unsure)])
    assert found.before_m == 0.0
    assert found.after_m == pytest.approx(RADIUS_95 * 0.001 * abs(SIDEWAYS[1]) * SECONDS, rel=1e-6)


def test_models_that_disagree_widen_the_bound_by_their_weights() -> None:
    slower = MATRIX * np.array([[1.0], [0.9], [1.0]])
    plain, other = extended_of(TRAINING, NOTHING), extended_of(TRAINING, NOTHING, matrix=slower)
    sideways = [run_of(SIDEWAYS, "sideways", split="validation")]
    (found,) = extrapolations_of(sideways, plain, plain, [(0.8, plain), (0.2, other)])
    apart = 0.1 * 0.2 * SECONDS  # m between the two ends
    assert found.after_m == pytest.approx(RADIUS_95 * np.sqrt(0.2) * apart, rel=1e-6)
