"""Twists of wheel samples, corrected by all terms of a model; batch and stream share this code."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.errors import DataError, PluginError
from omnibench.robot.effects.effect import MotionEffect, Need
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog
from omnibench.robot.signals import Signals

_MISSING: dict[Need, str] = {
    "wheel_angles": "absolute wheel angles (phi_* in wheels), which were not recorded",
    "session_time": "the time since the session's start (started_at in trajectories), which is not known",
    "session": "the session's name (session in trajectories), which is not known",
}


def corrected_twists(terms: Sequence[Term], signals: Signals, matrix: Array) -> tuple[Array, Array | None]:
    """Twists (F, 3) corrected by motion effects, and the velocity (F, 2) that world effects add in the world frame.

    Every correction is computed from the uncorrected signals, and corrections add up, so that their order does not
    matter. The velocity is None if no term acts in the world. PluginError: a correction has a wrong shape.
    """
    rates, of_body, of_world = signals.rates, None, None
    for term in terms:
        stage, added = term.effect.stage, _correction(term, signals)
        if stage == "body":
            of_body = added if of_body is None else of_body + added
        elif stage == "world":
            of_world = added if of_world is None else of_world + added
        else:
            rates = rates + added
    twists = signals.twists if rates is signals.rates else rates @ matrix.T
    return twists if of_body is None else twists + of_body, of_world


def check_needs(terms: Sequence[Term], log: WheelLog) -> None:
    """Raise DataError, in one line, if a log lacks data that an effect needs."""
    recorded = {"wheel_angles": log.wheel_angles, "session_time": log.started_at, "session": log.session}
    for term in terms:
        for need in sorted(term.effect.needs):
            if need in recorded and recorded[need] is None:
                raise DataError(
                    f"effect {term.name!r} needs {_MISSING[need]}; record it, or take the effect out of the calibration"
                )


def _correction(term: Term, signals: Signals) -> Array:
    """The correction of one term, its shape checked."""
    effect = term.effect
    assert isinstance(effect, MotionEffect)
    added = effect.correction(signals, term.values)
    shape = signals.rates.shape
    if effect.stage == "body":
        shape = (shape[0], 3)
    elif effect.stage == "world":
        shape = (shape[0], 2)
    if added.shape != shape:
        raise PluginError(f"effect {term.name!r}: its correction has shape {added.shape}, expected {shape}")
    return added
