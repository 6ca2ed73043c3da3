"""Commands, motors and controllers that cannot be: one line each, with the way out."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.simulate.commands import Command
from omnibench.simulate.motors import Controller, Encoder, Motor, check_reach, drive_session


@given(st.floats(0.05, 4), st.floats(-math.pi, math.pi), st.floats(-5, 5))
def test_the_speed_that_is_proposed_fits_and_little_more_does_not(
    speed: float, direction: float, turn_rate: float
) -> None:
    command = Command(speed, direction, turn_rate)
    try:
        check_reach(APR_02, [command], Motor())
    except ConfigError as error:
        (proposal,) = re.findall(r"give it a speed of at most ([\d.]+) m/s", str(error))
        proposed = float(proposal)
        check_reach(APR_02, [Command(proposed, direction, turn_rate)], Motor())
        with pytest.raises(ConfigError):
            check_reach(APR_02, [Command(proposed * 1.02, direction, turn_rate)], Motor())


def test_a_command_faster_than_the_motors_is_refused_in_one_line() -> None:
    fits = Command(0.2, 0.0, 0.35)
    with pytest.raises(ConfigError) as caught:
        check_reach(APR_02, [fits, Command(2.0, 0.0, 0.35)], Motor())
    told = str(caught.value)
    assert "command v2_a0_w0.35 (speed 2 m/s, direction 0 deg, turn rate 0.35 rad/s)" in told
    assert "wheel c would need 12.16 rad/s, its motor reaches 10.42 rad/s" in told
    assert "give it a speed of at most 1.52 m/s" in told
    assert "\n" not in told


def test_a_turn_faster_than_the_motors_is_refused_with_the_greatest_rate() -> None:
    with pytest.raises(ConfigError, match=r"turning at more than 7.11 rad/s alone is too fast"):
        check_reach(APR_02, [Command(0.0, 0.0, 8.0)], Motor())
    check_reach(APR_02, [Command(0.0, 0.0, 7.11)], Motor())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"coulomb_friction": 2.0}, "coulomb_friction 2 N m is above static_friction 0.6 N m"),
        ({"static_friction": 100.0}, "the motor never turns: 67.5 N m at the full voltage"),
        ({"resistence": 1.0}, "unknown key 'resistence'; did you mean 'resistance'"),
        ({"inductance": 0.0}, "inductance: .* greater than 0"),
    ],
)
def test_a_motor_that_cannot_be_is_refused_in_one_line(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate(Motor, settings, "motor")


def test_a_controller_that_does_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match="no wheel would ever turn"):
        validate(Controller, {"proportional": 0, "integral": 0}, "controller")


def test_a_sample_period_of_broken_milliseconds_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"sample_period 0\.0125 s: .* whole number of milliseconds"):
        drive_session(Motor(), Controller(), Encoder(), [], 0.0125, np.zeros(3))


def test_as_many_motors_as_wheels_are_asked_for() -> None:
    with pytest.raises(ConfigError, match="2 motors for 3 wheels"):
        drive_session([Motor(), Motor()], Controller(), Encoder(), [], 0.01, np.zeros(3))
