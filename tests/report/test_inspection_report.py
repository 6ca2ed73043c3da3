"""The report of an inspection: motions that were driven, what can be identified, and that the answer comes first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import assert_picture_comes_first
from recording_samples import sample
from report_page import Page
from syrupy.assertion import SnapshotAssertion
from wheeled_samples import DIFF

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.inspect import inspect_dataset
from omnibench.report.recording import inspection_report
from omnibench.report.render import write_document
from omnibench.robot.kinematics import Robot


def driving(robot: Robot, *twists: tuple[float, float, float]) -> list[Trajectory]:
    """Runs of four seconds, each at one twist by the design values."""
    times = np.arange(1, 81) * 0.05
    return [
        Trajectory(
            id=f"run-{number}",
            split="train",
            times=times,
            rates=np.tile(np.array(twist) @ robot.signal_equations.T, (len(times), 1)),
            pose_times=np.zeros(1),
            poses=np.zeros((1, 3)),
        )
        for number, twist in enumerate(twists)
    ]


OMNI = sample().dataset.robot


@pytest.mark.parametrize(
    ("twist", "kinds"),
    [
        ((0.2, 0.0, 0.0), {"straight", "forward"}),
        ((-0.2, 0.0, 0.0), {"straight", "backward"}),
        ((0.1, 0.0, 0.02), {"straight", "forward"}),  # what a straight line of uneven wheels turns by
        ((0.2, 0.0, 0.5), {"curves to the left", "forward"}),
        ((0.0, 0.2, -0.5), {"curves to the right", "sideways to the left"}),
        ((0.0, -0.2, 0.0), {"straight", "sideways to the right"}),
        ((0.0, 0.0, 0.5), {"on the spot to the left"}),
        ((0.0, 0.0, -0.5), {"on the spot to the right"}),
    ],
)
def test_a_motion_is_known_by_its_direction_and_turn(twist: tuple[float, float, float], kinds: set[str]) -> None:
    found = inspection_report.driven_motions(driving(OMNI, twist), OMNI)
    assert {motion.name for motion in found if motion.driven} == kinds
    assert all(motion.share in (0.0, 1.0) for motion in found)


def test_time_at_rest_is_no_motion() -> None:
    found = inspection_report.driven_motions(driving(OMNI, (0.2, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)), OMNI)
    shares = {motion.name: motion.share for motion in found}
    assert shares["straight"] == pytest.approx(0.5) == shares["on the spot to the left"]
    assert "×" not in repr(inspection_report.motion_table(found).rows)  # a speed that is rounding is zero
    on_two_wheels = inspection_report.driven_motions(driving(DIFF, (0.2, 0.0, 0.0)), DIFF)
    assert not [motion for motion in on_two_wheels if motion.name.startswith("sideways")]


def test_motions_that_are_missing_on_both_sides_are_named_once() -> None:
    missing = inspection_report.missing_in_words(inspection_report.driven_motions(driving(OMNI, (0.2, 0.0, 0.0)), OMNI))
    assert missing == "in curves to the left, in curves to the right, on the spot, backward or sideways"


@pytest.fixture(scope="module")
def recorded() -> Dataset:
    return sample().dataset


@pytest.fixture(scope="module")
def file(recorded: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("inspection") / "report.html"
    write_document(inspection_report.inspection_document(recorded, inspect_dataset(recorded)), file)
    return file


@pytest.fixture(scope="module")
def report(file: Path) -> Page:
    return Page(file.read_text(encoding="utf-8"))


def test_the_report_reads_as_before(report: Page, snapshot: SnapshotAssertion) -> None:
    assert report.words() == snapshot


def test_every_parameter_has_its_precision(recorded: Dataset, report: Page) -> None:
    found = inspect_dataset(recorded).identifiability.parameters
    rows = report.tables["Wheels, as these runs determine them"][1:]
    assert [row[3] == "determined" for row in rows] == [parameter.told for parameter in found]
    assert {row[1][-1] for row in rows} == {"m", "°"}


@pytest.mark.slow
def test_the_paths_stand_in_the_first_900_pixels(file: Path) -> None:
    assert_picture_comes_first(file)


def test_runs_that_are_all_alike_leave_motions_open(recorded: Dataset, tmp_path: Path) -> None:
    only = [replace(run, split="train") for run in recorded.trajectories if run.command == "straight"]
    few = replace(recorded, trajectories=tuple(only), scans=None)
    write_document(inspection_report.inspection_document(few, inspect_dataset(few)), tmp_path / "report.html")
    told = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "To train, it was never driven in curves to the left" in told.text
    assert "Part of the matrix stays open" in told.text
