"""Joining data sets: the runs of several recordings of one robot in one, each recording with sessions of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.splits import complete
from omnibench.errors import DataError
from omnibench.robot.kinematics import Robot

SCANS_LEFT_OUT = "scans are left out of joined data sets"
_SAME_PERIOD = 0.1  # share by which sample periods may differ: as between drives of one robot (chosen)


def joined(first: Dataset, others: Sequence[Dataset]) -> Dataset:
    """The runs of data sets of one robot in one, under the first one's name. Splits stay.

    Ids and sessions that two of them share get the name of their data set before them; a session without a name is
    called as its data set. Absolute angles, targets and covariances that only some have are left out, and so are scans.
    DataError: another robot, or another sample period.
    """
    if not others:
        return first
    datasets = (first, *others)
    for dataset in others:
        check_fits(first, dataset)
    made = make_dataset(
        first.name,
        first.robot,
        first.sample_period,
        complete(distinct_runs([(dataset.name, dataset.trajectories) for dataset in datasets])),
        description=first.description,
        source="; ".join(dict.fromkeys(dataset.source for dataset in datasets if dataset.source)),
        licence="; ".join(dict.fromkeys(dataset.licence for dataset in datasets if dataset.licence)),
        simulated=any(dataset.simulated for dataset in datasets),
    )
    warnings = [warning for dataset in datasets for warning in dataset.warnings]
    if any(dataset.scans is not None for dataset in datasets):
        warnings.append(SCANS_LEFT_OUT)
    return replace(made, warnings=tuple(dict.fromkeys([*warnings, *made.warnings])))


class _Described(Protocol):
    """A data set, or its header: name, robot and sample period."""

    @property
    def name(self) -> str: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def sample_period(self) -> float: ...


def check_fits(first: _Described, other: _Described, names: tuple[str, str] | None = None) -> None:
    """DataError: another robot or sample period than the first's. names: of both in messages, as their folders."""
    one, another = names or (first.name, other.name)
    robots = [dataset.robot.model_dump(exclude={"name"}) for dataset in (first, other)]
    if different := _first_difference(robots[0], robots[1]):
        raise DataError(
            f"data set {another}: its robot is not that of {one} ({different}); give both the same robot.yaml "
            "(omnibench import dataset FOLDER --set robot=FILE)"
        )
    if abs(other.sample_period / first.sample_period - 1) > _SAME_PERIOD:
        raise DataError(
            f"data set {another}: its wheels were sampled every {other.sample_period:g} s, those of {one} every "
            f"{first.sample_period:g} s; take each by itself"
        )


def _first_difference(one: Any, other: Any, place: str = "") -> str:
    """The first difference of two documents in words, such as ``wheels.0.radius: 0.06 and 0.05``; empty if none."""
    pairs: list[tuple[str, Any, Any]]
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        pairs = [(name, one.get(name), other.get(name)) for name in dict.fromkeys([*one, *other])]
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        pairs = [(str(index), mine, theirs) for index, (mine, theirs) in enumerate(zip(one, other, strict=True))]
    else:
        return "" if one == other else f"{place}: {other} and {one}"
    found = (_first_difference(mine, theirs, f"{place}.{name}".lstrip(".")) for name, mine, theirs in pairs)
    return next(filter(None, found), "")


def distinct_runs(recordings: Sequence[tuple[str, Sequence[Trajectory]]]) -> list[Trajectory]:
    """The runs of recordings, which are given with their names, under ids and sessions that no two recordings share."""
    runs = []
    ids, sessions = set[str](), set[str]()
    for name, (_, trajectories) in zip(_distinct([name for name, _ in recordings]), recordings, strict=True):
        of_sessions = {run.session: run.session or name for run in trajectories}
        of_sessions = {
            given: f"{name}/{session}" if session in sessions else session for given, session in of_sessions.items()
        }
        taken = set(ids)
        for run in trajectories:
            new = f"{name}/{run.id}" if run.id in taken else run.id
            runs.append(replace(run, id=new, session=of_sessions[run.session]))
            ids.add(new)
        sessions |= set(of_sessions.values())
    return runs


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, of which those that occur before have a number behind them."""
    return [name if name not in names[:index] else f"{name}-{index + 1}" for index, name in enumerate(names)]
