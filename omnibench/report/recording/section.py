"""The report on a recording, and the section on it that other reports include."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.true_poses import TruePath
from omnibench.errors import DataError
from omnibench.report.blocks import Block, Callout, Choice, Document, Fact, Facts, Section, simulated_badge
from omnibench.report.numbers import fixed
from omnibench.report.recording.contents import contents_table
from omnibench.report.recording.player import player
from omnibench.report.recording.room_figures import all_runs, one_run
from omnibench.report.recording.runs import representative_runs
from omnibench.report.recording.slam_figures import error_figures
from omnibench.report.recording.slam_tables import accuracy_blocks
from omnibench.report.recording.wheel_figures import wheel_rates
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.planar import placed, seen_from
from omnibench.slam.accuracy import SlamAccuracy, slam_accuracy


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
    sections = [Section("recorded", "What was recorded", (*_about(dataset, notes), contents_table(dataset)))]
    if known and accuracy is None:
        accuracy = slam_accuracy(dataset, known)
    if accuracy is not None:
        errors = error_figures(dataset, known) if known else ()
        sections.append(Section("slam", "SLAM against the truth", (*accuracy_blocks(accuracy), *errors)))
    sections += _pictures(dataset, "", known, plan, starts or {})
    return Document(
        title=f"Recording: {dataset.name}",
        subtitle=dataset.description,
        sections=tuple(sections),
        badges=simulated_badge(dataset.simulated),
    )


def has_recording(dataset: Dataset) -> bool:
    """True if a data set holds more than wheel rates and poses: scans, or targets of the wheels."""
    return dataset.scans is not None or any(run.targets is not None for run in dataset.trajectories)


def recording_section(dataset: Dataset) -> Section:
    """The section on a recording for another report. DataError in one line: broken scans."""
    parts = _pictures(dataset, "recording-", {}, None, {})
    about = "What was recorded, all paths, wheel rates, and runs step by step."
    return Section("recording", "Recording", (contents_table(dataset),), tuple(parts), about=about, folded=True)


def _about(dataset: Dataset, notes: Sequence[str]) -> tuple[Block, ...]:
    durations = np.array([run.pose_times[-1] for run in dataset.trajectories])
    facts = [
        Fact("Data set", dataset.name, "simulated" if dataset.simulated else ""),
        Fact("Source", dataset.source),
        Fact("Licence", dataset.licence),
        Fact("Robot", dataset.robot.name),
        Fact("Runs", str(len(dataset.trajectories)), f"{fixed(float(durations.sum()) / 60, 1)} min in all"),
    ]
    return (
        Callout("Before you read on", tuple(notes)),
        Callout("Warnings on reading the data", dataset.warnings, "warning"),
        Facts(tuple(fact for fact in facts if fact.value)),
    )


def _pictures(
    dataset: Dataset,
    prefix: str,
    truth: Mapping[str, TruePath],
    plan: RoomPlan | None,
    starts: Mapping[str, Array],
) -> list[Section]:
    """The sections on the room, the wheels and the step-by-step player."""
    runs = representative_runs(dataset)
    odometry = OdometryModel.of_design(dataset.robot, "arc")
    from_start = {run.id: _outlines(plan, starts.get(run.id)) for run in runs.values()}
    walls = {run.id: [placed(run.start, outline) for outline in from_start[run.id]] for run in runs.values()}
    first = next(iter(runs.values()))
    rooms: dict[str, tuple[Block, ...]] = {
        name: (one_run(dataset, run, odometry, truth.get(run.id), walls[run.id]),) for name, run in runs.items()
    }
    wheels: dict[str, tuple[Block, ...]] = {name: (wheel_rates(run, dataset.robot),) for name, run in runs.items()}
    exactness: tuple[str, ...] = ()
    if plan is not None and not _all_known(runs, starts):
        exactness = (
            f"The floor plan ({plan.name}) is drawn from the robot's mark; for a run that began beside the mark it is "
            "shifted by that distance.",
        )
    return [
        Section(
            f"{prefix}room",
            "The room" if dataset.scans is not None else "Paths",
            (Callout("Floor plan", exactness), all_runs(dataset, first, from_start[first.id]), Choice("Run", rooms)),
        ),
        Section(f"{prefix}wheels", "Wheels", (Choice("Run", wheels),)),
        Section(f"{prefix}player", "Step by step", (player(dataset, runs, odometry, truth, walls),)),
    ]


def _all_known(runs: Mapping[str, Trajectory], starts: Mapping[str, Array]) -> bool:
    return all(run.id in starts for run in runs.values())


def _outlines(plan: RoomPlan | None, start: Array | None) -> list[Array]:
    """The walls of a floor plan relative to a start pose (3,) in it (default: its own), closed (n, 2) each, m."""
    if plan is None:
        return []
    return [seen_from(plan.start if start is None else start, outline) for outline in plan.outlines]
