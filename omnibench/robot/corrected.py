"""Twists of wheel samples, corrected by all terms of a model; batch and stream share this code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omnibench.errors import DataError, PluginError
from omnibench.robot.effects.effect import MotionEffect, Need
from omnibench.robot.effects.forms import correction_of
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog
from omnibench.robot.signals import Signals

_MISSING: dict[Need, str] = {
    "wheel_angles": "absolute wheel angles (phi_* in wheels), which were not recorded",
    "session_time": "the time since the session's start (started_at in trajectories), which is not known",
    "session": "the session's name (session in trajectories), which is not known",
}


@dataclass(frozen=True, eq=False)
class Corrected:
    """Wheel samples with the corrections of all terms.

    rates (F, N), rad/s, and steering (F, S), rad: as the wheels truly turn and point. body (F, 3): added to the twist
    of the robot's centre. world (F, 2): added to the velocity in the reference's frame, m/s. None: no term acts there.
    """

    rates: Array
    steering: Array | None
    body: Array | None = None
    world: Array | None = None


def corrected(terms: Sequence[Term], signals: Signals) -> Corrected:
    """The wheel samples with all corrections, each computed from the uncorrected signals, so that their order does not
    matter. PluginError: a correction has a wrong shape.
    """
    rates, steering, of_body, of_world = signals.rates, signals.steering, None, None
    for term in terms:
        stage, added = term.effect.stage, _correction(term, signals)
        if stage == "body":
            of_body = added if of_body is None else of_body + added
        elif stage == "world":
            of_world = added if of_world is None else of_world + added
        elif stage == "steering":
            assert steering is not None  # its shape was checked
            steering = steering + added
        else:
            rates = rates + added
    return Corrected(rates, steering, of_body, of_world)


def corrected_twists(terms: Sequence[Term], signals: Signals, matrix: Array) -> tuple[Array, Array | None]:
    """Twists (F, 3) of the tracked point with all corrections, and the velocity (F, 2) that world effects add.

    The velocity is None if no term acts in the world. PluginError: a correction has a wrong shape.
    """
    true = corrected(terms, signals)
    mount = signals.robot.mount
    if mount is None and true.rates is signals.rates and true.steering is signals.steering:
        twists = signals.twists
    else:
        twists = signals.robot.drive.signals(true.rates, true.steering) @ matrix.T
    if true.body is None:
        return twists, true.world
    return twists + (true.body if mount is None else true.body @ mount.twist.T), true.world


def needs_of(terms: Sequence[Term]) -> frozenset[Need]:
    """All that the effects of some terms need."""
    return frozenset().union(*(term.effect.needs for term in terms))


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
    added = correction_of(effect, signals, term.values)
    shape = signals.rates.shape
    if effect.stage == "body":
        shape = (shape[0], 3)
    elif effect.stage == "world":
        shape = (shape[0], 2)
    elif effect.stage == "steering":
        shape = (shape[0], len(signals.robot.drive.steered))
    if added.shape != shape:
        raise PluginError(f"effect {term.name!r}: its correction has shape {added.shape}, expected {shape}")
    return added
