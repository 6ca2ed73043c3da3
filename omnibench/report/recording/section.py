"""The report on a recording, and the section on it that other reports include."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.true_poses import TruePath
from omnibench.errors import DataError
from omnibench.report.blocks import (
    Block,
    Callout,
    Choice,
    Document,
    Fact,
    Facts,
    FigureGrid,
    Section,
    answer_section,
    simulated_badge,
)
from omnibench.report.numbers import count, fixed, significant
from omnibench.report.recording.contents import contents_table
from omnibench.report.recording.player import player
from omnibench.report.recording.room_figures import all_runs, one_run
from omnibench.report.recording.runs import representative_runs
from omnibench.report.recording.slam_figures import error_figures
from omnibench.report.recording.slam_tables import accuracy_tiles, bias_table, error_table, errors_in_words
from omnibench.report.recording.wheel_figures import wheel_rates
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.planar import placed, seen_from
from omnibench.slam.accuracy import SlamAccuracy, slam_accuracy
from omnibench.words import plural


class RoomPlan(Protocol):
    """A room whose walls are known.

    start (3,): the robot's mark, m, m, rad. outlines: the walls, closed (n, 2) each, m, in the room's frame.
    """

    @property
    def name(self) -> str: ...
    @property
    def start(self) -> Array: ...
    @property
    def outlines(self) -> Sequence[Array]: ...


def recording_document(
    dataset: Dataset,
    *,
    truth: Mapping[str, TruePath] | None = None,
    plan: RoomPlan | None = None,
    starts: Mapping[str, Array] | None = None,
    accuracy: SlamAccuracy | None = None,
    notes: Sequence[str] = (),
) -> Document:
    """The report on a recording as blocks: its contents, the room, the wheels, a run step by step.

    For simulated data: truth: true path of each run, which the reference poses are compared with. plan: the room.
    starts: true start pose (3,) of each run in that room, m, m, rad (default: the plan's start). accuracy: errors of
    the reference poses (default: computed from the truth). notes: remarks at the top of the report.

    DataError in one line: broken scans, or a truth of other runs.
    """
    known = truth or {}
    for run in dataset.trajectories if known else ():
        if run.id not in known:
            raise DataError(
                f"data set {dataset.name}: run {run.id} is not in the truth; name the truth of this data set"
            )
    if known and accuracy is None:
        accuracy = slam_accuracy(dataset, known)
    sections = [_answer(dataset, notes, accuracy, path_overview(dataset, plan, starts))]
    if accuracy is not None:
        errors = error_figures(dataset, known) if known else ()
        about = "Errors of the reference poses, over time and distance, and whether their covariances are right."
        tables = (error_table(accuracy), bias_table(accuracy))
        sections.append(Section("slam", "SLAM against the truth", (*tables, *errors), about=about, folded=True))
    sections += pictures(dataset, truth=known, plan=plan, starts=starts)
    contents = (contents_table(dataset), about_table(dataset))
    about = "Quantities, numbers and intervals, from motion command to reference pose."
    sections.append(Section("recorded", "What was recorded", contents, about=about, folded=True))
    return Document(
        title=f"Recording: {dataset.name}",
        subtitle=dataset.description,
        sections=tuple(sections),
        badges=simulated_badge(dataset.simulated),
    )


def _answer(dataset: Dataset, notes: Sequence[str], accuracy: SlamAccuracy | None, picture: FigureGrid) -> Section:
    """What is in a recording or, where the truth is known, how accurate its reference poses are; and its paths."""
    runs = dataset.trajectories
    seconds = sum(run.end for run in runs)
    metres = sum(float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum()) for run in runs)
    sentence = f"{plural(len(runs), 'run')} of {dataset.robot.name}, {significant(metres, 3)} m in {_minutes(seconds)}"
    tiles: tuple[Fact, ...] = (
        Fact("Runs", count(len(runs))),
        Fact("Driven", f"{significant(metres, 3)} m", f"in {_minutes(seconds)}"),
        Fact("Wheel samples", f"every {significant(1e3 * dataset.sample_period, 3)} ms"),
        Fact("Reference poses", count(sum(len(run.poses) for run in runs))),
    )
    if accuracy is not None:
        sentence += f". Their reference poses end {errors_in_words(accuracy)} from the truth on average"
        tiles = accuracy_tiles(accuracy)
    return answer_section(
        f"{sentence}.",
        tiles,
        picture,
        Callout("Before you rely on it", tuple(notes)),
        Callout("Warnings on reading the data", dataset.warnings, "warning"),
    )


def path_overview(
    dataset: Dataset, plan: RoomPlan | None = None, starts: Mapping[str, Array] | None = None
) -> FigureGrid:
    """The paths of all runs from one start, and the room where there are scans."""
    first = next(iter(representative_runs(dataset).values()))
    return all_runs(dataset, first, _outlines(plan, (starts or {}).get(first.id)))


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{fixed(seconds / 60, 1)} min"


def has_recording(dataset: Dataset) -> bool:
    """True if a data set holds more than wheel rates and poses: scans, or targets of the wheels."""
    return dataset.scans is not None or any(run.targets is not None for run in dataset.trajectories)


def recording_section(dataset: Dataset) -> Section:
    """The section on a recording for another report. DataError in one line: broken scans."""
    paths = Section("recording-paths", "Paths of all runs", (path_overview(dataset),))
    parts = (paths, *pictures(dataset, prefix="recording-"))
    about = "What was recorded, all paths, wheel rates, and runs step by step."
    return Section("recording", "Recording", (contents_table(dataset),), parts, about=about, folded=True)


def about_table(dataset: Dataset) -> Facts:
    """Name, source, licence and robot of a data set."""
    facts = [
        Fact("Data set", dataset.name, "simulated" if dataset.simulated else ""),
        Fact("Description", dataset.description),
        Fact("Source", dataset.source),
        Fact("Licence", dataset.licence),
        Fact("Robot", dataset.robot.name),
    ]
    return Facts(tuple(fact for fact in facts if fact.value))


def pictures(
    dataset: Dataset,
    *,
    prefix: str = "",
    truth: Mapping[str, TruePath] | None = None,
    plan: RoomPlan | None = None,
    starts: Mapping[str, Array] | None = None,
) -> list[Section]:
    """The sections on single runs: in their room, wheel rates, and the step-by-step player."""
    known, begun = truth or {}, starts or {}
    runs = representative_runs(dataset)
    odometry = OdometryModel.of_design(dataset.robot, "arc")
    from_start = {run.id: _outlines(plan, begun.get(run.id)) for run in runs.values()}
    walls = {run.id: [placed(run.start, outline) for outline in from_start[run.id]] for run in runs.values()}
    rooms: dict[str, tuple[Block, ...]] = {
        name: (one_run(dataset, run, odometry, known.get(run.id), walls[run.id]),) for name, run in runs.items()
    }
    wheels: dict[str, tuple[Block, ...]] = {name: (wheel_rates(run, dataset.robot),) for name, run in runs.items()}
    exactness: tuple[str, ...] = ()
    if plan is not None and not _all_known(runs, begun):
        exactness = (
            f"The floor plan ({plan.name}) is drawn from the robot's mark; for a run that began beside the mark it is "
            "shifted by that distance.",
        )
    return [
        Section(f"{prefix}player", "Step by step", (player(dataset, runs, odometry, known, walls),)),
        Section(f"{prefix}wheels", "Wheel rates", (Choice("Run", wheels),)),
        Section(
            f"{prefix}room",
            "Runs in their room" if dataset.scans is not None else "Single runs",
            (Callout("Floor plan", exactness), Choice("Run", rooms)),
        ),
    ]


def _all_known(runs: Mapping[str, Trajectory], starts: Mapping[str, Array]) -> bool:
    return all(run.id in starts for run in runs.values())


def _outlines(plan: RoomPlan | None, start: Array | None) -> list[Array]:
    """The walls of a floor plan relative to a start pose (3,) in it (default: its own), closed (n, 2) each, m."""
    if plan is None:
        return []
    return [seen_from(plan.start if start is None else start, outline) for outline in plan.outlines]
