"""Division of imported runs into training and validation, and what they have in common."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Annotated, Any

from pydantic import BeforeValidator

from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.errors import ConfigError, DataError, nearest
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
    seen: Counter[Hashable] = Counter()
    splits: list[Split] = []
    for group in groups:
        splits.append("train" if seen[group] % 2 == 0 else "validation")
        seen[group] += 1
    return splits


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
