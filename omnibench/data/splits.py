"""Division of runs into training and validation, and the joining of several recordings of one robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Annotated, Any

from pydantic import BeforeValidator

from omnibench.data.dataset import Dataset, Split, Trajectory, every_second, repetitions, with_warnings
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.words import some

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
) -> list[Trajectory]:
    """The runs with their splits and the number of each repetition; runs that belong to no split are left out.

    train, validation: shell patterns (``*``, ``?``, ``[ab]``) of ``names`` (default: the runs' ids). Where only one
    side has patterns, everything else goes to the other; with both, names that match neither are left out. Without
    patterns the splits are ``otherwise``; by default every second run of a command validates. kind: what the names are,
    for messages. ConfigError: a pattern matches nothing, or a name matches both sides.
    """
    splits: Sequence[Split | None] = otherwise or every_second([run.command for run in runs])
    if train or validation:
        names = names or [run.id for run in runs]
        trains, validates = _matching("train", names, train, kind), _matching("validation", names, validation, kind)
        if both := [name for name in names if name in trains & validates]:
            raise ConfigError(f"{kind} {both[0]!r} is in both train and validation; name it once")
        rest: Split | None = "validation" if not validation else "train" if not train else None
        splits = ["train" if name in trains else "validation" if name in validates else rest for name in names]
    numbers = repetitions([run.command or run.id for run in runs])
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
    others = set(names) - _matching("leave_out", names, patterns, kind, "#*")
    if not others:
        raise ConfigError(f"leave_out: every {kind} matches {', '.join(patterns)}; keep one at least")
    return others


def _matching(option: str, names: Sequence[str], patterns: Sequence[str], kind: str, parts: str = "") -> set[str]:
    """The names that match one of the patterns, by themselves or followed by ``parts``."""
    matched = set[str]()
    for pattern in patterns:
        matching = {name for name in names if fnmatchcase(name, pattern) or fnmatchcase(name, pattern + parts)}
        if not matching:
            known = sorted(set(names))
            raise ConfigError(f"{option}: no {kind} matches {pattern!r}; {nearest(pattern, known)}found: {some(known)}")
        matched |= matching
    return matched


def training_split(dataset: Dataset) -> tuple[Trajectory, ...]:
    """The training trajectories of a data set; DataError when there are none."""
    if trajectories := dataset.split("train"):
        return trajectories
    raise DataError(f"data set {dataset.name}: the training split is empty; set split to train for some trajectories")


_SAME_PERIOD = 0.1  # share by which sample periods may differ: as between drives of one robot (chosen)


def joined(first: Dataset, others: Sequence[Dataset]) -> Dataset:
    """The runs of data sets of one robot in one, under the first one's name. Splits stay.

    Ids and sessions that two of them share get the name of their data set before them; a session without a name is
    called as its data set. Absolute angles, targets and covariances that only some have are left out, and so are scans.
    DataError: another robot, or another sample period.
    """
    if not others:
        return first
    parts = (first, *others)
    return with_warnings(put_together(parts), [warning for part in parts for warning in part.warnings])


def put_together(parts: Sequence[Dataset], places: Sequence[str] | None = None) -> Dataset:
    """The data set that joins others as ``joined`` does, without their warnings.

    places: what messages call them, default: their names. DataError: another robot or sample period than the first's.
    """
    first, places = parts[0], places or [part.name for part in parts]
    robot = _flat(first.robot.model_dump(exclude={"name"}))
    for place, other in zip(places, parts, strict=True):
        another = _flat(other.robot.model_dump(exclude={"name"}))
        for key in robot | another:
            if robot.get(key) != another.get(key):
                what = f"its robot is not that of {places[0]} ({key}: {another.get(key)} and {robot.get(key)})"
                way = "give both the same robot.yaml (omnibench import dataset FOLDER --set robot=FILE)"
                raise DataError(f"data set {place}: {what}; {way}")
        if abs(other.sample_period / first.sample_period - 1) > _SAME_PERIOD:
            periods = f"every {other.sample_period:g} s, those of {places[0]} every {first.sample_period:g} s"
            raise DataError(f"data set {place}: its wheels were sampled {periods}; take each by itself")
    runs, names = list[Trajectory](), list[str]()
    for part in parts:
        names.append(part.name if part.name not in names else f"{part.name}-{len(names) + 1}")
        prefix, ids, sessions = f"{names[-1]}/", {run.id for run in runs}, {run.session for run in runs}
        for run in part.trajectories:
            session = run.session or names[-1]
            session = prefix + session if session in sessions else session
            runs.append(replace(run, id=prefix + run.id if run.id in ids else run.id, session=session))
    texts: dict[str, Any] = {}
    for name in ("description", "source", "licence"):
        texts[name] = "; ".join(dict.fromkeys(text for part in parts if (text := getattr(part, name))))
    if any(part.scans is not None for part in parts):
        texts["warnings"] = ("scans are left out of joined data sets",)
    simulated = any(part.simulated for part in parts)
    return Dataset(first.name, first.robot, first.sample_period, tuple(complete(runs)), simulated=simulated, **texts)


def _flat(document: Any, place: str = "") -> dict[str, Any]:
    """The values of a document by their places in it, such as ``wheels.0.radius``."""
    if not isinstance(document, Mapping | list | tuple):
        return {place: document}
    items = document.items() if isinstance(document, Mapping) else enumerate(document)
    return {key: value for name, part in items for key, value in _flat(part, f"{place}.{name}".lstrip(".")).items()}
