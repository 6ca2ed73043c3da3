"""The suite of faults (tests/studies/chaos.py), for some seconds, and what its account would notice."""

from __future__ import annotations

import numpy as np
import pytest
from chaos.audit import Account, account_replays, account_stream, check_going_on, check_path, check_stamps
from chaos.robots import ORIGIN, STEP, batch, calibrations
from chaos.run import run
from chaos.witness import Heard

COUNTS = dict.fromkeys(
    (
        *("samples", "missing", "gaps", "clock_jumps", "unpublished", "duplicates", "late", "bad_stamps"),
        *("not_finite", "too_fast", "wrong_joints", "undecodable", "overflow"),
    ),
    0,
)


def heard(samples: list[int], numbers: list[int] | None = None, poses: np.ndarray | None = None) -> Heard:
    """Odometry of these samples, numbered one by one."""
    count = len(samples)
    return Heard(
        b"node",
        np.arange(1, count + 1) if numbers is None else np.array(numbers),
        ORIGIN + STEP * np.array(samples),
        np.zeros((count, 3)) if poses is None else poses,
    )


def test_every_sample_is_accounted_for_through_random_faults() -> None:
    said: list[str] = []
    assert run(15.0, 5, said.append), "\n".join(said)


@pytest.mark.parametrize(
    ("counted", "unaccounted"), [({"missing": 2}, 0), ({}, 2), ({"unpublished": 2}, 0), ({"late": 1}, 1)]
)
def test_samples_that_do_not_come_back_are_noticed_unless_they_are_counted(
    counted: dict[str, int], unaccounted: int
) -> None:
    part = heard([0, 1, 2, 5, 6])
    account = account_stream([part], [np.array([0, 1, 2, 5, 6])], COUNTS | counted, COUNTS)
    assert account.unaccounted == unaccounted
    assert len(account.problems) == (unaccounted > 0)


def test_a_replay_that_was_not_taken_whole_is_noticed() -> None:
    stamps = ORIGIN + STEP * np.arange(10)
    before = heard([-5], [0])
    part = heard([0, 1, 2, 3, 4, 7, 8, 9])
    account = account_replays([(stamps, True, True)], [before, part], COUNTS | {"samples": 8}, COUNTS, 5)
    assert (account.published, account.unaccounted) == (8, 2)


def test_a_node_that_leaves_out_what_the_one_before_had_taken_is_noticed() -> None:
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(0.01, 0.005, (50, 3)), axis=0)
    for later, problems in ((30, 0), (31, 1)):
        account = Account()
        check_going_on(account, path[[20]], np.array([20]), path[[30]], np.array([later]), path)
        assert len(account.problems) == problems


def test_a_stamp_that_comes_twice_is_noticed() -> None:
    account = Account()
    check_stamps(account, [heard([1, 2, 2, 3])])
    assert account.repeated == 1
    assert account.problems


def test_odometry_that_is_off_the_batch_odometry_is_noticed() -> None:
    rng = np.random.default_rng(1)
    stamps = (ORIGIN + STEP * np.arange(50)).tolist()
    angles = np.cumsum(rng.normal(0.01, 0.005, (50, 3)), axis=0)
    paths = [batch(calibration, stamps, angles) for calibration in calibrations()]
    path, right, wrong = paths[0].copy(), Account(), Account()
    check_path(right, heard(list(range(50)), poses=path), np.arange(50), paths, 0)
    assert (right.compared, right.problems) == (49, [])
    path[30:, 0] += 1e-7
    check_path(wrong, heard(list(range(50)), poses=path), np.arange(50), paths, 0)
    assert wrong.problems
