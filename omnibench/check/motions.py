"""Motions that a recording lacks, and runs and repetitions that are too few, in words.

A kind of motion is told by its twist; reports show those that were driven.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from omnibench.check.evidence import Evidence
from omnibench.data.finding import Finding, Kind
from omnibench.data.stored import drawn_runs
from omnibench.fit.evaluate import command_names
from omnibench.fit.open_combinations import open_sentences
from omnibench.fit.span import driven_span
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural

# Least share of the time in motion that counts as driven on purpose; chosen: about a second in a minute.
SHARE = 0.02
TURNING, _STRAIGHT = 0.06, 0.04  # rad/s from which on a robot turns, and up to which it goes straight; chosen
MOVING = 0.02  # m/s from which on it moves; chosen
_ON_THE_SPOT = 0.1  # way ahead, as a share of the wheels' way by turning, below which it turns on the spot; chosen
_SECTOR = 30.0  # deg about an axis that count as along it; chosen
_SLIDING = 0.35  # rad between two directions of motion that count as different; chosen
_FEW_RUNS, _SOME_RUNS = 3, 7  # runs up to which no interval can be had, and few
_LEAST_REPEATED = 2
_SIDES = ("left", "right")

Kinds = Mapping[str, NDArray[np.bool_]]
"""Twists (n,) of each kind, True, by its name."""


def motion_kinds(twists: Array, robot: Robot) -> Kinds:
    """The kinds that a robot can drive, with those of twists (n, 3), m/s, m/s and rad/s, that are of each.

    A twist is straight or turns, and goes forward, backward or sideways. A steered robot turns in curves alone.
    """
    speed, turn = np.hypot(twists[:, 0], twists[:, 1]), twists[:, 2]
    moving, turns = speed > MOVING, np.abs(turn) > TURNING
    spot = turns & (speed < _ON_THE_SPOT * robot.reach * np.abs(turn) + MOVING) & robot.drive.direct
    angle = np.degrees(np.arctan2(twists[:, 1], twists[:, 0]))
    sides = dict(zip(_SIDES, (turn > 0, turn < 0), strict=True))
    kinds = {"straight": moving & (np.abs(turn) < _STRAIGHT)}
    kinds |= {f"curves to the {side}": turns & ~spot & to_side for side, to_side in sides.items()}
    if robot.drive.direct:
        kinds |= {f"on the spot to the {side}": spot & to_side for side, to_side in sides.items()}
    ahead = moving & ~spot
    kinds |= {"forward": ahead & (np.abs(angle) <= _SECTOR), "backward": ahead & (np.abs(angle) >= 180 - _SECTOR)}
    sideways = zip(_SIDES, (90.0, -90.0), strict=True) if len(robot.motions) == 3 else ()
    return kinds | {f"sideways to the {side}": ahead & (np.abs(angle - middle) <= _SECTOR) for side, middle in sideways}


def turning(kinds: Kinds, side: str) -> NDArray[np.bool_]:
    """True (n,) for twists that turn to a side, left or right, in curves or on the spot."""
    curves = kinds[f"curves to the {side}"]
    return curves | kinds.get(f"on the spot to the {side}", np.zeros_like(curves))


def lacking(evidence: Evidence) -> Iterator[Finding]:
    """Motions, runs and repetitions that are missing: noise and intervals cannot be had without them."""
    runs = evidence.dataset.trajectories
    if any(run.references is not None for run in runs):
        yield from left_open(evidence)
    else:
        for what, fix in _missing_motions(evidence):
            yield _warning("motion_missing", what, fix)
    if len(runs) <= _FEW_RUNS:
        what = f"there {'is' if len(runs) == 1 else 'are'} only {plural(len(runs), 'run')}: nothing is left to judge a "
        fix = f"record {_SOME_RUNS + 1} runs or more, of several commands"
        yield _warning("few_runs", f"{what}calibration by", fix)
    if max(Counter(command_names(runs)).values()) < _LEAST_REPEATED:
        what = "no command was driven twice: noise and errors of the model cannot be told apart"
        yield _warning("few_repetitions", what, "drive every command three times")


def left_open(evidence: Evidence) -> Iterator[Finding]:
    """Findings on what the training runs leave open: with no reference of turning, or none of lengths, a warning."""
    training = evidence.dataset.split("train")
    for number, sentence in enumerate(open_sentences(evidence.dataset.robot, training) if training else ()):
        what, _, fix = sentence.rpartition("; " if "; " in sentence else ": ")
        missing = what.startswith(("no reference tells of turning", "no reference tells of lengths"))
        kind: Kind = "motion_missing" if missing else "references_leave_open"
        where = f"the recording, {number + 1}" if number else "the recording"
        yield Finding(kind=kind, what=what, where=where, severity="warning" if missing else "note", fix=fix)


def _warning(kind: Kind, what: str, fix: str) -> Finding:
    return Finding(kind=kind, what=what, where="the recording", severity="warning", fix=fix)


def _missing_motions(evidence: Evidence) -> Iterator[tuple[str, str]]:
    """Motions that a robot of this kind needs and that were not driven; none where the reference does not move."""
    robot, runs = evidence.dataset.robot, drawn_runs(evidence.aligned)
    if not any(run.rates.any() for run in runs):
        yield "the robot never moved", "drive it, and see that the columns of the wheels are those that count"
        return
    if (windows := evidence.windows) is None:
        return
    seconds = windows.times[:, 1] - windows.times[:, 0]
    velocity, rates = windows.moved / seconds, windows.turned / seconds
    kinds = motion_kinds(np.column_stack([velocity.real, velocity.imag, rates]), robot)
    active = (np.abs(rates) > TURNING) | (np.abs(velocity) > MOVING)
    if not active.any():
        return
    whole = float(seconds[active].sum())

    def share(chosen: NDArray[np.bool_]) -> float:
        return float(seconds[active & chosen].sum()) / whole

    sides = [side for side in _SIDES if share(turning(kinds, side)) < SHARE]
    turns = "three circles" if robot.drive.steered else "three turns on the spot at 0.5 rad/s"
    if len(sides) == 2:
        yield "the robot never turned", f"drive {turns}, to either side"
    elif sides:
        yield f"the robot never turned {sides[0]}", f"drive {turns}, to the {sides[0]}"
    if share(kinds["straight"]) < SHARE:
        yield "the robot never went straight", "drive three straight lines of 2 m and more"
    moved = windows.moved[np.abs(velocity) > MOVING]
    if robot.slides and not robot.skid and len(moved):
        # 1 if the robot moved along one line in its frame, 0 all round.
        spread = abs(complex(np.sum(moved**2))) / float(np.sum(np.abs(moved) ** 2))
        if spread >= math.cos(2 * _SLIDING):
            yield "the robot went in one direction only", "drive forward, and sideways to either side, 2 m each"
    if robot.drive.direct and not sides and robot.slides:
        spot = share(kinds["on the spot to the left"] | kinds["on the spot to the right"])
        shares = driven_span(runs).shares
        if spot < SHARE and shares[-1] < SHARE / 2 and len(shares) == 3:
            yield "the robot never turned on the spot", "drive three turns at 0.5 rad/s, to either side"
