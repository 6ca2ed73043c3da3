"""Cross-validation on a few runs, where what the other folds predict is known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from extended_samples import FORWARD, SIDEWAYS, TURN, extended_of, run_of
from screening_samples import FIRST, SECOND, screening

from omnibench.data.dataset import Trajectory
from omnibench.discover.held_out import (
    folds_of_commands,
    folds_of_kinds,
    folds_of_repetitions,
    held_out_chi_square,
    is_confirmed,
    kinds_of_runs,
    random_folds_of_repetitions,
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


def test_commands_of_few_repetitions_begin_with_one_fold_after_the_other() -> None:
    assert folds_of_repetitions(runs_of("a", "a", "b", "b", "c", "c")).tolist() == [0, 1, 1, 2, 2, 3]


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


def test_a_run_is_predicted_by_the_mean_of_the_other_folds() -> None:
    values = values_of_other_folds(constants(1.0, 2.0, 6.0), [0], np.array([0, 1, 2]))
    assert values[:, 0].tolist() == pytest.approx([4.0, 3.5, 1.5])


def test_runs_of_one_fold_never_predict_each_other() -> None:
    values = values_of_other_folds(constants(1.0, 2.0, 6.0), [0], np.array([0, 0, 1]))
    assert values[:, 0].tolist() == pytest.approx([6.0, 6.0, 1.5])


def test_a_single_fold_leaves_nothing_to_fit() -> None:
    assert values_of_other_folds(constants(1.0, 2.0), [0], np.array([0, 0])).tolist() == [[0.0], [0.0]]


def test_the_gain_of_a_column_is_the_fall_of_each_held_out_runs_squares() -> None:
    gains = held_out_chi_square(constants(1.0, 2.0, 6.0), [], [0], np.array([0, 1, 2]))
    assert gains.tolist() == pytest.approx([1 - 3**2, 4 - 1.5**2, 36 - 4.5**2])


def test_a_column_is_confirmed_if_held_out_runs_gain_by_two_standard_errors() -> None:
    given = screening({"heading_drift": FIRST, "floor_drift": SECOND}, {}, [0, 10, 0, 0, 0])
    assert is_confirmed(given.data, [0], [1], given.folds)
    assert not is_confirmed(given.data, [0], [2], given.folds)
    assert not is_confirmed(given.data, [0, 1], [1], given.folds)
