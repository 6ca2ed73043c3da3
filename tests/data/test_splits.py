"""Division of imported runs into training and validation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.data.splits import complete, divided, division_in_words


def run(name: str, command: str | None) -> Trajectory:
    return Trajectory(name, "train", np.ones(1), np.ones((1, 3)), np.arange(2.0), np.zeros((2, 3)), command=command)


RUNS = [run("a", "left"), run("b", "left"), run("c", "right"), run("d", None)]


def test_every_second_run_of_a_command_validates_and_its_repetitions_are_numbered() -> None:
    runs = divided(RUNS, (), ())
    assert [each.split for each in runs] == ["train", "validation", "train", "train"]
    assert [each.repetition for each in runs] == [1, 2, 1, None]


def test_patterns_of_both_sides_leave_out_the_runs_of_neither() -> None:
    runs = divided(RUNS, ("a",), ("[bc]",))
    assert [(each.id, each.split) for each in runs] == [("a", "train"), ("b", "validation"), ("c", "validation")]


def test_patterns_may_be_of_other_names_and_go_before_the_splits_given() -> None:
    groups = ["x", "x", "y", "y"]
    assert [each.split for each in divided(RUNS, ("y",), (), "group", names=groups)].count("train") == 2
    assert {each.split for each in divided(RUNS, (), (), otherwise=["validation"] * 4)} == {"validation"}
    assert {each.split for each in divided(RUNS, ("*",), (), otherwise=["validation"] * 4)} == {"train"}


def test_what_only_some_runs_hold_is_left_out() -> None:
    with_angles = [replace(each, angles=np.ones((1, 3))) for each in RUNS]
    assert all(each.angles is not None for each in complete(with_angles))
    assert all(each.angles is None for each in complete([*with_angles, RUNS[0]]))


def test_a_division_says_how_many_runs_and_commands_each_side_has_and_by_what() -> None:
    words = division_in_words(divided(RUNS, (), ()), {})
    assert (
        words == "training 3 runs of 2 commands, validation 1 run of 1 command, every second run of a command validates"
    )
    named = division_in_words(divided(RUNS, (), ("b",)), {"validation": "b"})
    assert named == "training 3 runs of 2 commands, validation 1 run of 1 command, by validation=b"
    own = division_in_words(divided(RUNS, (), (), otherwise=["validation"] * 4), {})
    assert own == "training 0 runs, validation 4 runs of 2 commands, by the importer's own rule"
