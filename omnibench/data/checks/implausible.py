"""What a recording warns of: the explanation of its misfit to the design model, if one stands out."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.data.checks.explanations import odd_units, odd_wheels, ticks
from omnibench.data.checks.finding import Finding
from omnibench.data.checks.misfit import Explanation, Recording
from omnibench.data.checks.odd_steering import contradictions, frozen, odd_gears, odd_zeros
from omnibench.data.checks.option_words import warning_of
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import WheelLog

# Misfit of the design model (chosen): errors of calibration, slip and noise stay below, wrong units and wheels do not.
_SUSPICIOUS = 0.15
# A wrong zero of steering angles shows in less: all of a swerve base 10 degrees off leave 0.07; chosen so that a
# drive whose dimensions are 5 % off stays below.
_SUSPICIOUS_ZERO = 0.05
# A factor that is fitted is told in the place of a unit's that leaves more than this misfit, and this many times more
# (chosen): next to those of rpm and deg/s a gear is told by the rest that they leave.
_EXACT, _FAR_BETTER = 0.05, 0.5


def implausible(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> list[str]:
    """Warnings about units, wheels and steering, from a comparison of the reference with the design model's odometry.

    ``poses`` (K, 3) of each log are as recorded, at the log's stamps; headings may be wrapped.
    """
    if not any(log.rates.any() for log in logs):
        return ["the wheels never turn; check the omega_* columns"]
    findings, unit = _found(Recording.of(robot, logs, poses))
    return [warning_of(robot, finding, unit=unit) for finding in findings]


def _found(recording: Recording) -> tuple[list[Finding], bool]:
    """Findings of a recording, and whether they are of units."""
    if recording.misfit < _SUSPICIOUS_ZERO:
        return contradictions(recording), False
    zeros = odd_zeros(recording)
    if recording.misfit < _SUSPICIOUS:
        best = None if (found := contradictions(recording)) else _best(recording, zeros)
    else:
        units, gears, high = odd_units(recording), odd_gears(recording), ticks(recording)
        single = [each for each in (*units, *gears) if each.unit and len(each.mistakes) == 1]  # the simplest first
        best = _best(recording, single, [*zeros, *high])
        best = best or _best(recording, [*units, *gears, *odd_wheels(recording), *zeros, *high])
        found = [] if best else contradictions(recording) or frozen(recording)
    return ([mistake.finding() for mistake in best.mistakes], best.unit) if best else (found, False)


def _best(
    recording: Recording, explanations: Sequence[Explanation], fitted: Sequence[Explanation] = ()
) -> Explanation | None:
    """The best explanation, if it explains the misfit; none if a fitted one is far better."""
    best = min(explanations, key=lambda explanation: explanation.misfit, default=None)
    if best is None or best.misfit >= best.may_remain * recording.misfit:
        return None
    better = any(each.misfit < _FAR_BETTER * best.misfit for each in fitted)
    return None if best.misfit > _EXACT and better else best
