"""Sessions that differ, in recordings made without the code that compares them and of a real robot, and in commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from commands import Command
from hidden.session_sets import session_set

from omnibench.data.dataset import Dataset
from omnibench.data.storage import save_dataset
from omnibench.fit.sessions import SessionComparison, compare_sessions
from omnibench.robot.calibration import Calibration, matrix_rows, write_calibration
from omnibench.robot.model import OdometryModel


def compared(dataset: Dataset, **changes: object) -> SessionComparison:
    """The comparison by the design's matrix, of runs that are changed."""
    model = OdometryModel(dataset.robot, dataset.robot.inverse_kinematic_matrix, "arc", (), dataset.sample_period)
    return compare_sessions(model, [replace(run, **changes) for run in dataset.trajectories])


def alone(dataset: Dataset, lone: int) -> SessionComparison:
    """The comparison of one run with all others, as two sessions."""
    names = ["lone" if index == lone else "others" for index in range(len(dataset.trajectories))]
    runs = tuple(replace(run, session=name) for run, name in zip(dataset.trajectories, names, strict=True))
    return compared(replace(dataset, trajectories=runs))


@pytest.mark.parametrize(("wheels", "kind"), [("abc", "all wheels"), ("b", "one wheel")])
def test_a_session_with_larger_wheels_is_said_to_differ_and_by_how_much(wheels: str, kind: str) -> None:
    found = compared(session_set("small", 3, change=0.01, wheels=wheels))
    (difference,) = found.differences
    assert (difference.session, difference.others, difference.commands) == ("s2", ("s1",), 12)
    assert difference.kind == kind
    assert difference.radii[0].low < 0.01 < difference.radii[0].high
    (sentence,) = found.sentences
    assert "in s2 against s1, 12 commands" in sentence
    assert ("all wheels" if len(wheels) > 1 else "wheel b") in sentence
    assert "% larger (95 %" in sentence


def test_a_chance_so_small_that_no_noise_is_known_so_well_is_not_given_as_a_figure() -> None:
    (sentence,) = compared(session_set("small", 3, change=0.02)).sentences
    assert "(chance < 10⁻⁹)" in sentence


def test_of_several_sessions_the_one_that_differs_is_named() -> None:
    found = compared(session_set("small_sessions", 5, change=-0.02))
    (difference,) = found.differences
    assert (difference.session, difference.others) == ("s4", ("s1", "s2", "s3"))
    assert "% smaller" in found.sentences[0]


@pytest.mark.parametrize(
    ("seed", "changes"),
    [
        (0, {"noise": "plain"}),
        (1, {"noise": "correlated"}),
        (2, {"noise": "mixed"}),
        (3, {"noise": "slip"}),
        (4, {"effect": "rotation_translation_coupling"}),  # what the model lacks in both sessions
        (1, {"validation": "flower"}),  # other commands from which nothing deviates
    ],
)
def test_sessions_that_are_alike_are_not_said_to_differ(seed: int, changes: dict[str, str]) -> None:
    assert compared(session_set("small", seed, **changes)) == SessionComparison()


@pytest.mark.parametrize("lone", [23, 101, 104, 108])  # those that the noise model alone would have said to differ
def test_a_run_that_is_a_session_of_its_own_is_judged_by_the_scatter_of_its_command(lone: int) -> None:
    assert alone(session_set("small", 1, noise="mixed"), lone) == SessionComparison()


def test_a_single_run_with_much_larger_wheels_is_said_to_differ() -> None:
    dataset = session_set("small", 2, change=0.05)
    runs = [run for run in dataset.trajectories if run.split == "train"]
    lone = next(run for run in dataset.trajectories if run.split == "validation")
    (difference,) = compared(replace(dataset, trajectories=(*runs, lone))).differences
    assert (difference.session, difference.runs, difference.commands) == ("s2", 1, 1)


def test_of_other_commands_it_is_said_that_sessions_and_commands_cannot_be_told_apart() -> None:
    found = compared(session_set("small", 1, effect="rotation_translation_coupling", validation="flower"))
    assert found.differences == ()
    assert found.other_commands is not None
    assert "other commands" in found.sentences[0]


def test_splits_stand_for_sessions_that_were_not_recorded() -> None:
    found = compared(session_set("small", 3, change=0.01), session=None)
    assert [(each.session, each.others) for each in found.differences] == [("validation", ("train",))]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({"session": "s1"}, "one session"), ({"command": None}, "repeats"), ({"poses": None}, "no trajectory")],
)
def test_what_cannot_be_compared_is_said_with_the_reason(changes: dict[str, object], reason: str) -> None:
    dataset = session_set("small", 3, change=0.01)
    if "poses" in changes:
        runs = [replace(run, poses=run.poses[:1], pose_times=run.pose_times[:1]) for run in dataset.trajectories]
        found = compared(replace(dataset, trajectories=tuple(runs)))
    else:
        found = compared(dataset, **changes)
    assert reason in found.untested
    assert found.sentences == ()
    assert [found.untested in doubt for doubt in found.doubts] == [True] * ("session" not in changes)


def test_a_session_that_shares_no_command_with_the_others_is_named() -> None:
    dataset = session_set("small_sessions", 5)
    renamed = [
        replace(run, command=f"{run.command}, other") if run.session == "s2" else run for run in dataset.trajectories
    ]
    (sentence,) = compared(replace(dataset, trajectories=tuple(renamed))).doubts
    assert "no run of s2" in sentence


def test_repetitions_that_agree_exactly_show_what_differs_and_nothing_else() -> None:
    dataset = session_set("small", 3, change=0.01)
    by_command = {(run.session, run.command): run for run in dataset.trajectories}
    same = {run.command: run for run in dataset.split("train")}

    def of(first: dict[object, object], key: object, run: object) -> object:
        return replace(run, **{name: getattr(first[key], name) for name in ("times", "rates", "poses", "pose_times")})

    alike = tuple(of(by_command, (run.session, run.command), run) for run in dataset.trajectories)
    assert [each.session for each in compared(replace(dataset, trajectories=alike)).differences] == ["s2"]
    none = tuple(of(same, run.command, run) for run in dataset.trajectories)
    assert compared(replace(dataset, trajectories=none)).differences == ()


def test_squares_and_a_single_run_of_a_real_robot_are_not_said_to_be_another_session(omni3: Dataset) -> None:
    found = compared(omni3)
    assert found.differences == ()
    assert found.other_commands is not None
    assert alone(omni3, 32).differences == ()


WORDS = "The sessions differ: in s2 against s1, 12 commands"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data set whose validation session has larger wheels, and a calibration of its design."""
    dataset = session_set("small", 3, change=0.02)
    runs = [run for run in dataset.trajectories if run.repetition is not None and run.repetition < 4]
    save_dataset(replace(dataset, trajectories=tuple(runs)), tmp_path / "data")
    design = Calibration(
        name="design",
        robot=dataset.robot,
        sample_period=dataset.sample_period,
        matrix=matrix_rows(dataset.robot.inverse_kinematic_matrix),
        integration="arc",
    )
    write_calibration(design, tmp_path / "design.yaml")
    return tmp_path / "data"


@pytest.mark.slow
def test_evaluate_and_compare_say_after_their_verdict_that_the_sessions_differ(command: Command, data: Path) -> None:
    lines = command("evaluate", data.parent / "design.yaml", data).stdout.splitlines()
    assert lines[-3].startswith("held out (")
    assert lines[-1].startswith(WORDS)
    sets, calibrators = {"robot": {"path": str(data)}}, ["theoretical", "closed_form"]
    config = {"name": "sessions", "datasets": sets, "cost": "final_pose", "calibrators": calibrators}
    Path("compare.yaml").write_text(yaml.safe_dump(config | {"certificate": None}))
    told = command("compare", "compare.yaml", "-o", "results")
    assert WORDS in told.stdout, told.stderr
    assert WORDS in Path("results/report.html").read_text()
