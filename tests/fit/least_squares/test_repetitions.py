"""Repetitions are runs of a command within a session: what differs between sessions is no noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import repeating_runs, repetitions_of_commands

Split = Literal["train", "validation"]


def run(split: Split, session: str | None, command: str | None) -> Trajectory:
    return Trajectory(
        id=f"{split} {session} {command}",
        split=split,
        command=command,
        session=session,
        times=np.array([0.1, 0.2]),
        rates=np.ones((2, 3)),
        pose_times=np.array([0.0, 0.2]),
        poses=np.zeros((2, 3)),
    )


def groups(runs: Sequence[Trajectory]) -> list[tuple[int, ...]]:
    return list(repetitions_of_commands(runs).groups)


def test_runs_of_different_sessions_are_no_repetitions() -> None:
    runs = [run("train", "A", "go"), run("train", "B", "go")]
    assert groups(runs) == []
    assert repetitions_of_commands(runs).words == "no session repeats a command"


def test_repetitions_across_splits_count_where_no_split_repeats_a_command_in_a_session() -> None:
    runs = [
        run("train", "A", "go"),
        run("train", "B", "go"),
        run("validation", "A", "go"),
        run("validation", "B", "go"),
    ]
    assert groups(runs) == [(0, 2), (1, 3)]
    assert repetitions_of_commands(runs).description == "4 runs of 1 command"
    assert groups([*runs, run("train", "A", "go")]) == [(0, 4)]


def test_runs_of_a_split_are_repetitions_where_sessions_are_not_known() -> None:
    runs = [run("train", None, "go"), run("train", None, "go"), run("validation", None, "go"), run("train", None, None)]
    assert groups(runs) == [(0, 1)]
    assert repetitions_of_commands(runs).words == "each within one split"
    assert groups(runs[1:]) == []


def test_runs_of_the_validation_serve_the_noise_only_where_no_training_run_is_repeated() -> None:
    train, others = [run("train", "A", "go")], [run("validation", "A", "go"), run("validation", "B", "go")]
    assert repeating_runs(train, others) == others[:1]
    assert repeating_runs([*train, *train], others) == []
    assert repeating_runs([run("train", None, "go")], [run("validation", None, "go")]) == []
