"""The makers of recordings with something hidden: what they hide is what they say, and nobody can read it off."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
from hidden.absorbed import ABSORBED
from hidden.disturbances import NULL_KINDS, PLAIN
from hidden.experiment import DESIGNS, RAMP, ROBOT, SAMPLE, Command, Run, plan, true_matrix
from hidden.fine_structure import FINE
from hidden.form import Form, Make
from hidden.forms import FORMS
from hidden.motion import Correction, Grid
from hidden.outside import OUTSIDE
from hidden.pairs import PAIRS
from hidden.sets import LEVELS, make_set
from hidden.signature import Sight, projected

from omnibench.robot.effects.effect import make_term
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

KNOWN = {**FORMS, **{name: form for name, form in ABSORBED.items() if name != "tyre_wear"}}
MATRIX = true_matrix(np.random.default_rng(1))
RUNS = plan(DESIGNS["sessions"], np.random.default_rng(2))[:180:6]
# The catalogue's acceleration is a filtered derivative, 50 ms behind that of ramps of 300 ms.
BEHIND = {"acceleration_slip": 0.05 / RAMP, "load_transfer": 0.05 / RAMP}


def values_of(form: Form, factor: float = 1.0) -> dict[str, float]:
    return form.scaled(form.direction(np.random.default_rng(3)), factor)


def poses_of(grid: Grid, make: Make, values: Mapping[str, float]) -> Array:
    return grid.poses(make(grid, values, np.random.default_rng(4)))


@pytest.fixture(scope="module")
def grid() -> Grid:
    return Grid(RUNS, MATRIX)


@pytest.fixture(scope="module")
def sight() -> Sight:
    return Sight(RUNS, MATRIX, PLAIN.known(MATRIX))


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
    assert difference < BEHIND.get(name, 2e-3) * effect


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


@pytest.mark.parametrize("name", FORMS)
def test_a_third_form_is_not_the_catalogues_and_yet_mostly_like_it(name: str, sight: Sight) -> None:
    form = FORMS[name]
    values = values_of(form)
    signature = sight.of(form.third(sight.grid, values, np.random.default_rng(4)))
    fitted, left = projected(sight, form, values, signature)
    assert 0.005 < left / (signature @ signature) < 0.5
    along = [fitted[key] * values[key] for key in form.plausible if key != "radius_s4"]  # s4 is not driven here
    assert sum(along) > 0.3 * sum(values[key] ** 2 for key in form.plausible if key != "radius_s4")


@pytest.mark.parametrize("name", FORMS)
def test_a_third_form_is_not_the_blind_one(name: str, grid: Grid) -> None:
    form = FORMS[name]
    values = values_of(form)
    corrections = [make(grid, values, np.random.default_rng(4)) for make in (form.third, form.blind)]
    third, blind = (grid.poses(each if each.chance is None else each + each.chance) for each in corrections)
    assert np.linalg.norm(third - blind) > 0.02 * np.linalg.norm(third - grid.poses(Correction()))


@pytest.mark.parametrize("name", FORMS)
def test_a_third_form_is_the_same_in_finer_steps_and_with_more_runs(name: str, grid: Grid) -> None:
    form = FORMS[name]
    values = values_of(form)
    few = Grid(RUNS[:20], MATRIX, steps=2)
    coarse, fine = (poses_of(each, form.third, values) for each in (few, grid))
    effect = coarse - few.poses(Correction())
    assert np.linalg.norm(coarse - fine[: len(coarse)]) < 0.05 * np.linalg.norm(effect)


@pytest.mark.parametrize("name", FORMS)
def test_an_effect_of_no_size_leaves_every_pose_as_it_is(name: str, grid: Grid) -> None:
    nothing, still = values_of(FORMS[name], 0.0), grid.poses(Correction())
    for make in (FORMS[name].blind, FORMS[name].third):
        np.testing.assert_array_equal(poses_of(grid, make, nothing), still)


@pytest.mark.parametrize("name", FINE)
def test_fine_structure_is_beyond_the_matrix_and_no_size_of_it_is_nothing(name: str, sight: Sight) -> None:
    make, grid = FINE[name].make, sight.grid
    signature = sight.of(make(grid, {"size": FINE[name].plausible}, np.random.default_rng(4)))
    assert signature @ signature > 1
    np.testing.assert_array_equal(poses_of(grid, make, {"size": 0.0}), grid.poses(Correction()))


@pytest.mark.parametrize("name", FINE)
def test_fine_structure_is_the_same_in_finer_steps_and_with_more_runs(name: str, grid: Grid) -> None:
    make, values = FINE[name].make, {"size": FINE[name].plausible}
    few = Grid(RUNS[:20], MATRIX, steps=2)
    coarse, fine = (poses_of(each, make, values) for each in (few, grid))
    effect = coarse - few.poses(Correction())
    assert np.linalg.norm(coarse - fine[: len(coarse)]) < 0.05 * np.linalg.norm(effect)


@pytest.mark.parametrize("name", ABSORBED)
def test_what_is_called_absorbed_leaves_nothing_beyond_the_matrix(name: str) -> None:
    sight = Sight([run for run in RUNS if run.session == "s2"], MATRIX, PLAIN.known(MATRIX))
    form = ABSORBED[name]
    signature = sight.of(form.matched(sight.grid, values_of(form), np.random.default_rng(0)))
    assert signature @ signature < 1


def test_the_projection_of_a_matched_form_is_its_own_values(sight: Sight) -> None:
    form = FORMS["rotation_translation_coupling"]
    values = values_of(form)
    signature = sight.of(form.matched(sight.grid, values, np.random.default_rng(0)))
    found, left = projected(sight, form, values, signature)
    assert found == pytest.approx(values, rel=1e-4)
    assert left < 1e-3


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


def test_nothing_in_a_recording_names_what_is_hidden() -> None:
    dataset, _ = make_set("single", "heading_drift", "strong", 1002, design="small")
    words = " ".join(
        [dataset.name, dataset.description, dataset.source]
        + [f"{run.id} {run.command} {run.session}" for run in dataset.trajectories]
    )
    assert not [name for name in (*FORMS, *OUTSIDE, "drift", "heading") if name in words]


def test_the_same_seed_makes_the_same_set_and_another_another() -> None:
    sets = [make_set("outside", "kick", "medium", seed, design="small") for seed in (1003, 1003, 1004)]
    first, second, third = (dataset.hash for dataset, _ in sets)
    assert first == second != third


def test_pairs_are_of_known_effects_and_there_are_enough_of_everything() -> None:
    assert {name for pair in PAIRS for name in pair} <= set(FORMS)
    assert len(PAIRS) >= 12
    assert len(OUTSIDE) >= 8
    assert {covariate for unheard in OUTSIDE.values() for covariate in unheard.covariates} == {
        "command",
        "elapsed time",
        "heading",
        "place",
        "order of runs",
        "wheel rate",
        "wheel angle",
        "acceleration",
        "stamps",
    }
    assert len(NULL_KINDS) >= 6
