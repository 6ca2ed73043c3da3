"""Sentences on directions of wheel rates that recordings do not identify, and how a calibration treats them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from omnibench.data.dataset import Trajectory
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.span import Unidentified, WheelDirection, driven_span, wheel_directions
from omnibench.robot.kinematics import Robot

# Share of the strongest direction: one that is driven less is mentioned, since slip counts five times as much along it.
# Half of it and twice say the same of three recordings (tests/studies/constants_fit.py).
_LITTLE_SHARE = 0.2


def open_directions(directions: Sequence[WheelDirection]) -> Iterator[str]:
    """A sentence for every direction that the runs drive little or not at all."""
    kept = "calibration keeps the design values there"
    for each in directions:
        words, motion, share = each.words, each.motion, each.share_in_words
        if each.identified:
            continue
        if each.state == "undriven" and motion:
            yield (
                f"no run drives the wheels along {words} ({motion}): the matrix is not determined along it, "
                f"and {kept}; {_advice(motion)}"
            )
        elif each.state == "undriven":
            alone = len(directions) == 4 and sum(other.state == "undriven" for other in directions) == 1
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
    for each in directions:
        if each.identified and each.share < _LITTLE_SHARE:
            yield (
                f"the runs drive the wheels along {each.words}{f' ({each.motion})' if each.motion else ''} with only "
                f"{each.share_in_words}: slip counts {1 / each.share:.0f} times as much there"
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


def kept_motions(
    robot: Robot, trajectories: Sequence[Trajectory], parameterisation: ParameterisationName, unidentified: Unidentified
) -> tuple[WheelDirection, ...]:
    """Motions of which a calibration on these runs keeps the design values, so that no interval tells of them."""
    if parameterisation == "geometry":
        return ()
    directions = wheel_directions(robot, driven_span(trajectories))
    open_ones = (each for each in directions if not each.identified and each.motion)
    return tuple(each for each in open_ones if not (each.state == "weak" and unidentified == "fit"))


def warnings_of_calibration(
    robot: Robot,
    trajectories: Sequence[Trajectory],
    parameterisation: ParameterisationName,
    unidentified: Unidentified,
) -> tuple[str, ...]:
    """Warnings of a calibration on these runs: a sentence for every unidentified direction, and how it was treated."""
    sentences = []
    for each in wheel_directions(robot, driven_span(trajectories)):
        if each.identified or not each.motion:  # where the wheels only slip, no motion of the robot depends on it
            continue
        subject = f"{each.words} ({each.motion}) do"
        if each.state == "weak":
            subject += f": {each.share_in_words}, which slip alone can make"
        if parameterisation == "geometry":
            end = "the geometry cannot keep design values there, so what was fitted to it rests on slip and noise"
        elif each.state == "weak" and unidentified == "fit":
            end = "what was fitted there rests on slip and noise"
        else:
            end = "kept at the design values"
        sentences.append(f"these data do not identify what wheel rates along {subject}; {end}")
    return tuple(sentences)
