"""Sentences on directions of wheel rates that recordings do not identify, and how a calibration treats them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from omnibench.data.dataset import Trajectory
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.span import (
    DrivenSpan,
    Unidentified,
    aligned,
    direction_in_words,
    driven_span,
    motion_in_words,
    unidentified_directions,
)
from omnibench.robot.kinematics import Robot

_LITTLE_SHARE = 0.2  # share of the strongest direction: one that is driven less is mentioned; chosen


def open_directions(robot: Robot, span: DrivenSpan) -> Iterator[str]:
    """A sentence for every direction that the runs drive little or not at all."""
    kept = "calibration keeps the design values there"
    for direction in unidentified_directions(robot, span):
        state = span.state(direction)
        words, motion = direction_in_words(direction, robot.wheel_names), motion_in_words(direction, robot)
        share = f"{100 * span.share(direction):.1f} % of the strongest motion"
        if state == "undriven" and motion:
            yield (
                f"no run drives the wheels along {words} ({motion}): the matrix is not determined along it, "
                f"and {kept}; {_advice(motion)}"
            )
        elif state == "undriven":
            alone = len(robot.wheels) == 4 and len(span.null) == 1
            expected = ", as for any robot on four wheels that does not slip" if alone else ""
            yield f"no run drives the wheels along {words}{expected}: the matrix is not determined along it, and {kept}"
        elif motion:
            yield (
                f"these recordings hardly {_verb(motion)}: they drive the wheels along {words} ({motion}) with "
                f"{share}, which slip alone can do; what row 3 (heading) says of it cannot be identified, nor what "
                f"rows 1 (x) and 2 (y) say; {kept}, unless it is told to fit them; {_advice(motion)}"
            )
        else:
            yield f"the wheels go along {words}, which only slips, with {share}: slip cannot be identified, and {kept}"
    for direction in aligned(span.strong, robot):
        if span.share(direction) < _LITTLE_SHARE:
            words, motion = direction_in_words(direction, robot.wheel_names), motion_in_words(direction, robot)
            yield (
                f"the runs drive the wheels along {words}{f' ({motion})' if motion else ''} with only "
                f"{100 * span.share(direction):.1f} % of the strongest motion: slip counts "
                f"{1 / span.share(direction):.0f} times as much there"
            )


def _verb(motion: str) -> str:
    """The motion as an imperative, like ``turn the robot``."""
    if motion == "turning on the spot":
        return "turn the robot"
    return motion.replace("moving", "move the robot", 1)


def _advice(motion: str) -> str:
    """The recordings that would identify a motion, as an imperative."""
    if motion == "turning on the spot":
        return "record turns, on the spot or while driving"
    return "record other motions, too" if "while" in motion else f"record runs {motion.removeprefix('moving ')}"


def warnings_of_calibration(
    robot: Robot,
    trajectories: Sequence[Trajectory],
    parameterisation: ParameterisationName,
    unidentified: Unidentified,
) -> tuple[str, ...]:
    """Warnings of a calibration on these runs: a sentence for every unidentified direction, and how it was treated."""
    span = driven_span(trajectories)
    sentences = []
    for direction in unidentified_directions(robot, span):
        state = span.state(direction)
        motion = motion_in_words(direction, robot)
        if not motion:  # the wheels would only slip: no motion of the robot depends on it
            continue
        subject = f"{direction_in_words(direction, robot.wheel_names)} ({motion}) do"
        if state == "weak":
            subject += f": {100 * span.share(direction):.1f} % of the strongest motion, which slip alone can make"
        if parameterisation == "geometry":
            end = "the geometry cannot keep design values there, so what was fitted to it rests on slip and noise"
        elif state == "weak" and unidentified == "fit":
            end = "what was fitted there rests on slip and noise"
        else:
            end = "kept at the design values"
        sentences.append(f"these data do not identify what wheel rates along {subject}; {end}")
    return tuple(sentences)
