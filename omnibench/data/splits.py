"""Division of runs into training and validation, and the joining of several recordings of one robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Annotated, Any, Protocol

from pydantic import BeforeValidator

from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory, make_dataset
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.robot.kinematics import Robot
from omnibench.words import plural

_OPTIONAL = ("angles", "targets", "pose_covariances")  # fields of a run that all runs of a data set have, or none


def _as_names(value: Any) -> Any:
    values = value if isinstance(value, list | tuple) else (value,)
    # YAML reads a name made of digits as a number.
    return tuple(str(item) if isinstance(item, int) and not isinstance(item, bool) else item for item in values)


Names = Annotated[tuple[str, ...], BeforeValidator(_as_names)]
"""An option that takes one name or pattern, or a list of them."""


def divided(
    runs: Sequence[Trajectory],
    train: Sequence[str],
    validation: Sequence[str],
    kind: str = "run",
    *,
    names: Sequence[str] | None = None,
    otherwise: Sequence[Split] | None = None,
    alike: Sequence[Hashable] | None = None,
) -> list[Trajectory]:
    """The runs with their splits and the number of each repetition; runs that belong to no split are left out.

    train, validation: patterns as for ``split_by_name``, of ``names`` (default: the runs' ids). Without patterns the
    splits are ``otherwise``; by default every second run of a command validates. alike: equal for repetitions of one
    motion (default: the command). ConfigError as for ``split_by_name``.
    """
    splits: Sequence[Split | None] = otherwise or every_second([run.command for run in runs])
    if train or validation:
        splits = split_by_name(names or [run.id for run in runs], train, validation, kind)
    numbers = repetitions(alike or [run.command or run.id for run in runs])
    return [
        replace(run, split=split, repetition=number if run.command else None)
        for run, split, number in zip(runs, splits, numbers, strict=True)
        if split is not None
    ]


def complete(runs: Sequence[Trajectory]) -> list[Trajectory]:
    """The runs without what only some of them hold: absolute angles, targets, covariances of poses."""
    partial = [name for name in _OPTIONAL if any(getattr(run, name) is None for run in runs)]
    missing: dict[str, Any] = dict.fromkeys(partial)
    return [replace(run, **missing) for run in runs]


def remaining(names: Sequence[str], patterns: Sequence[str], kind: str) -> set[str]:
    """The names that match none of the shell patterns; ``run3`` stands for its parts ``run3#1`` ..., too.

    ConfigError: a pattern matches nothing, or all names match.
    """
    matched: set[str] = set()
    for pattern in patterns:
        matching = {name for name in names if fnmatchcase(name, pattern) or fnmatchcase(name, f"{pattern}#*")}
        if not matching:
            raise _unmatched("leave_out", pattern, names, kind)
        matched |= matching
    if matched >= set(names):
        raise ConfigError(f"leave_out: every {kind} matches {', '.join(patterns)}; keep one at least")
    return set(names) - matched


def _unmatched(option: str, pattern: str, names: Sequence[str], kind: str) -> ConfigError:
    known = sorted(set(names))
    shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
    return ConfigError(f"{option}: no {kind} matches {pattern!r}; {nearest(pattern, known)}found: {shown}")


def split_by_name(
    names: Sequence[str], train: Sequence[str], validation: Sequence[str], kind: str
) -> list[Split | None]:
    """The split of each name, by shell patterns (``*``, ``?``, ``[ab]``).

    When only one side has patterns, everything else goes to the other; with both, names that match neither get None.
    ConfigError: a pattern matches nothing, or a name matches both sides. ``kind`` is what the names are, for messages.
    """
    sides = {"train": train, "validation": validation}
    for side, patterns in sides.items():
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise _unmatched(side, pattern, names, kind)
    rest: Split | None = "validation" if not validation else "train" if not train else None
    return [_split_of(name, train, validation, rest, kind) for name in names]


def _split_of(
    name: str, train: Sequence[str], validation: Sequence[str], rest: Split | None, kind: str
) -> Split | None:
    trains, validates = (any(fnmatchcase(name, pattern) for pattern in side) for side in (train, validation))
    if trains and validates:
        raise ConfigError(f"{kind} {name!r} is in both train and validation; name it once")
    return "train" if trains else "validation" if validates else rest


def training_split(dataset: Dataset) -> tuple[Trajectory, ...]:
    """The training trajectories of a data set; DataError when there are none."""
    trajectories = dataset.split("train")
    if not trajectories:
        raise DataError(
            f"data set {dataset.name}: the training split is empty; set split to train for some trajectories"
        )
    return trajectories


def every_second(groups: Sequence[Hashable]) -> list[Split]:
    """Splits by turns within each group, in the order given; the first member trains."""
    return ["train" if number % 2 else "validation" for number in repetitions(groups)]


def repetitions(commands: Sequence[Hashable]) -> list[int]:
    """Number of each run among the runs of its command, from 1, in the order given."""
    seen: Counter[Hashable] = Counter()
    numbers = []
    for command in commands:
        seen[command] += 1
        numbers.append(seen[command])
    return numbers


def division_in_words(runs: Sequence[Trajectory], options: Mapping[str, Any]) -> str:
    """How imported runs are divided, and by what: ``training 8 runs of 4 commands, validation 4 runs of ...``.

    options: the importer's, with patterns under ``train`` and ``validation`` where these were given.
    """
    parts = []
    for split, name in zip(SPLITS, ("training", "validation"), strict=True):
        members = [run for run in runs if run.split == split]
        commands = {run.command for run in members if run.command is not None}
        of_commands = f" of {plural(len(commands), 'command')}" if commands else ""
        parts.append(f"{name} {plural(len(members), 'run')}{of_commands}")
    given = {side: options[side] for side in SPLITS if options.get(side)}
    if given:
        rule = f"by {', '.join(f'{side}={value}' for side, value in given.items())}"
    elif [run.split for run in runs] == every_second([run.command for run in runs]):
        rule = "every second run of a command validates"
    else:
        rule = "by the importer's own rule"
    return f"{', '.join(parts)}, {rule}"


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
