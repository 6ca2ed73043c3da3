"""Motions outside the training domain, and bounds on the predictions there that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from extended_samples import FORWARD, MATRIX, SECONDS, SIDEWAYS, TURN, extended_of, run_of

from omnibench.discover.held_out import extrapolations_of, training_domain

TRAINING = [run_of(FORWARD, "go", f"go {number}") for number in (1, 2)]
NOTHING = [np.zeros((2, 3)) for _ in TRAINING]
TURNED = [run_of(TURN, "turn", "turn 1", split="validation")]
RADIUS_95 = 2.45 / np.sqrt(2)  # of the circle that holds 95 % of errors whose mean square is 1


def test_the_training_domain_is_what_the_training_runs_drove() -> None:
    np.testing.assert_allclose(training_domain(extended_of(TRAINING, NOTHING)), [[0.2, 0.0, 0.0]], atol=1e-12)


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
