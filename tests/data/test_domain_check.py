"""What is said of runs that drive motions which a calibration's effects were not fitted to."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.domain_check import extrapolation_warning
from omnibench.robot.calibration import Calibration, EffectTerm, matrix_rows
from omnibench.simulate.source import simulate_like
from omnibench.testing import synthetic_robot

ROBOT = synthetic_robot()
MATRIX = ROBOT.inverse_kinematic_matrix
FORWARDS, SIDEWAYS, ON_THE_SPOT = (0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.8)
SLIP = EffectTerm(name="centripetal_slip", parameters={"k": 0.03})


def calibration(*effects: EffectTerm, **changes: Any) -> Calibration:
    """Fitted to driving forwards, unless it is changed."""
    plain: dict[str, Any] = {"name": "mine", "robot": ROBOT, "sample_period": 0.05, "integration": "arc"}
    plain |= {"matrix": matrix_rows(MATRIX), "effects": effects or (SLIP,), "driven": (FORWARDS,)}
    return Calibration(**(plain | changes))


def run(name: str, *twists: tuple[float, float, float], command: str | None = None) -> Trajectory:
    """Two seconds of each twist, with poses at the ends."""
    times = 0.05 * np.arange(1, 40 * len(twists) + 1)
    rates = np.repeat([np.linalg.solve(MATRIX, twist) for twist in twists], 40, axis=0)
    plain = Trajectory(name, "train", times, rates, np.array([0.0, times[-1]]), np.zeros((2, 3)), command=command)
    (driven,) = calibration(effects=()).model.poses([plain.log(plain.pose_times)])
    return replace(plain, poses=driven)


def test_runs_commands_motions_and_effects_are_told_in_one_line() -> None:
    runs = [run("1", FORWARDS), run("2", FORWARDS, SIDEWAYS, command="corner"), run("3", SIDEWAYS, command="side")]
    other = EffectTerm(name="heading_drift", parameters={"b": 0.001})
    told = extrapolation_warning(calibration(SLIP, other), runs)
    assert told is not None
    for part in ("2 of 3 runs", "'mine'", "(side, corner)", "0.20 m/s", "centripetal_slip, heading_drift"):
        assert part in told


def test_repetitions_of_a_command_are_named_once_and_of_many_commands_three() -> None:
    runs = [run(str(number), ON_THE_SPOT, command="turn") for number in range(4)]
    told = str(extrapolation_warning(calibration(), runs))
    assert "4 of 4 runs" in told
    assert "(turn), such as turning" in told
    aside = [run(name, SIDEWAYS) for name in "abcde"]
    assert "(a, b, c and 2 more)" in str(extrapolation_warning(calibration(), aside))


@pytest.mark.parametrize(
    "changes",
    [{"driven": (FORWARDS, SIDEWAYS, ON_THE_SPOT)}, {"driven": None}, {"driven": ()}, {"effects": ()}],
    ids=["all driven", "not known", "none", "no effects"],
)
def test_nothing_is_told_of_what_was_driven_or_where_nothing_is_at_stake(changes: dict[str, Any]) -> None:
    runs = [run("1", FORWARDS), run("2", SIDEWAYS), run("3", ON_THE_SPOT)]
    assert extrapolation_warning(calibration(), runs) is not None
    assert extrapolation_warning(calibration(**changes), runs) is None


def recorded(*runs: Trajectory) -> Dataset:
    return make_dataset("recorded", ROBOT, 0.05, runs)


def test_a_recording_simulated_again_is_warned_of_too() -> None:
    (warning,) = simulate_like(recorded(run("1", FORWARDS), run("2", SIDEWAYS)), calibration()).warnings
    assert warning.startswith("1 of 2 runs ")
    assert simulate_like(recorded(run("1", FORWARDS)), calibration()).warnings == ()
