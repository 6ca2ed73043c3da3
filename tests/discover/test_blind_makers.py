"""The makers of recordings with something hidden: what they hide is what they say, and nobody can read it off."""

import math
from collections.abc import Mapping

import numpy as np
import pytest
from hidden.absorbed import ABSORBED
from hidden.experiment import DESIGNS, RAMP, ROBOT, SAMPLE, Command, Run, plan, true_matrix
from hidden.form import Form, Make
from hidden.forms import FORMS
from hidden.motion import Correction, Grid
from hidden.sets import LEVELS, make_set

from omnibench.robot.effects.effect import make_term
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

pytestmark = pytest.mark.slow

KNOWN = {**FORMS, **{name: form for name, form in ABSORBED.items() if name != "tyre_wear"}}
MATRIX = true_matrix(np.random.default_rng(1))
RUNS = plan(DESIGNS["sessions"], np.random.default_rng(2))[:180:6]


def values_of(form: Form) -> dict[str, float]:
    return form.scaled(form.direction(np.random.default_rng(3)), 1.0)


def poses_of(grid: Grid, make: Make, values: Mapping[str, float]) -> Array:
    return grid.poses(make(grid, values, np.random.default_rng(4)))


@pytest.fixture(scope="module")
def grid() -> Grid:
    return Grid(RUNS, MATRIX)


def log_of(grid: Grid, index: int, poses: Array) -> WheelLog:
    """The log of a run from the first of these poses of all runs."""
    run, steps = grid.runs[index], round(SAMPLE / grid.step)
    rows = slice(grid.first[index], grid.first[index + 1])
    rates = grid.rates[rows].reshape(-1, steps, 3).mean(axis=1)
    times = SAMPLE * np.arange(1, len(rates) + 1)
    angles = run.angles + np.cumsum(rates * SAMPLE, axis=0)
    return WheelLog(times, rates, poses[grid.stamp_first[index]], run.stamps, angles, run.started_at, run.session)


def test_a_robot_without_an_effect_drives_the_arc_of_its_command() -> None:
    command = Command(0.2, 0.5, 0.35)
    start = np.array([0.1, -0.2, 1.0])
    run = Run("train", "s1", 1, 0.0, command, 0, 1, start, np.zeros(3))
    driven = Grid([run], ROBOT.inverse_kinematic_matrix).poses(Correction())
    turned = command.turn * (command.samples * SAMPLE - RAMP)
    chord = 2 * command.speed / command.turn * math.sin(turned / 2)
    direction = start[2] + command.direction + turned / 2
    expected = start + np.array([chord * math.cos(direction), chord * math.sin(direction), turned])
    np.testing.assert_allclose(driven[-1], expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", KNOWN)
def test_a_matched_form_moves_the_robot_as_the_catalogue_says(name: str, grid: Grid) -> None:
    form = KNOWN[name]
    values = values_of(form)
    term = make_term(name, values, ROBOT, sessions=("s1", "s2", "s3", "s4"))
    model = OdometryModel(ROBOT, MATRIX, "arc", (term,), SAMPLE)
    poses = poses_of(grid, form.matched, values)
    odometry = np.concatenate(model.reported([log_of(grid, index, poses) for index in range(len(grid.runs))]))
    effect, difference = (np.abs(poses - other).max() for other in (grid.poses(Correction()), odometry))
    assert effect > 1e-4
    # The catalogue's acceleration is a filtered derivative, 50 ms behind that of ramps of 300 ms.
    assert difference < (0.05 / RAMP if name in ("acceleration_slip", "load_transfer") else 2e-3) * effect


@pytest.mark.parametrize("name", FORMS)
def test_a_blind_form_is_another_than_the_catalogues_and_yet_close(name: str, grid: Grid) -> None:
    form = FORMS[name]
    values = values_of(form)
    correction = form.blind(grid, values, np.random.default_rng(4))
    if correction.chance is not None:  # the difference is jitter
        correction += correction.chance
    blind, matched = grid.poses(correction), poses_of(grid, form.matched, values)
    still = grid.poses(Correction())
    assert 0.003 < np.linalg.norm(blind - matched) / np.linalg.norm(matched - still) < 0.9


def test_a_set_is_as_hard_as_it_says_and_its_noise_is_what_it_says() -> None:
    dataset, truth = make_set("single", "thermal_radius_drift", "strong", 1001)
    sight = truth.sight()
    signature = truth.signature(sight)
    assert signature @ signature == pytest.approx(LEVELS["strong"], rel=0.02)
    assert [len(dataset.split(split)) for split in ("train", "validation")] == [180, 180]
    noise = [run.poses - clean.poses for run, clean in zip(dataset.trajectories, truth.clean, strict=True)]
    white = sight.whitened(np.concatenate(noise[:180]))
    white = white[white != 0]  # at t = 0 the start pose is exact
    assert white.std() == pytest.approx(1, abs=0.03)  # the encoders' part is in the rates, not here
    assert dataset.warnings == ()
