"""Screening what the plain matrix leaves, and what screened recordings can tell."""

from __future__ import annotations

import numpy as np
import pytest
from discovery_samples import shorn, simulated

from omnibench.discover.fitting import Extended, Fit, extend, fit_matrix
from omnibench.discover.selection.detectability import detectability_of
from omnibench.discover.selection.evidence import Missing
from omnibench.discover.selection.model_selection import select_effects
from omnibench.discover.selection.screening import Screening, screen_again, screen_extended, screen_plain
from omnibench.fit.trajectory_fit import usable_runs

LEFT_OUT = ("heading_drift",)


@pytest.fixture(scope="module")
def plain() -> Fit:
    dataset = shorn(simulated(validation=None), session="first")
    runs = usable_runs(dataset.split("train"))
    return fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)


@pytest.fixture(scope="module")
def screening(plain: Fit) -> Screening:
    return screen_plain(plain, LEFT_OUT)


@pytest.fixture(scope="module")
def extended(plain: Fit, screening: Screening) -> Extended:
    (coupling,) = (group for group in screening.groups.effects if group.name == "rotation_translation_coupling")
    return extend(plain, [coupling])


def test_effects_that_are_left_out_have_no_columns(screening: Screening) -> None:
    names = {group.name for group in screening.groups.effects}
    assert "rotation_translation_coupling" in names
    assert not names & set(LEFT_OUT)


def test_an_extended_model_is_screened_with_its_effects_put_back(extended: Extended) -> None:
    again = screen_extended(extended, LEFT_OUT)
    (coupling,) = (group for group in again.groups.effects if group.name == "rotation_translation_coupling")
    values, _ = again.beyond_matrix().estimate(coupling.index)
    np.testing.assert_allclose(values, extended.values, rtol=0.05)
    assert again.beyond_matrix().chi_square(coupling.index) > 10 * len(extended.values)


def test_columns_are_made_once_for_both_screenings(screening: Screening, extended: Extended) -> None:
    assert screen_again(extended, screening).groups is screening.groups
    assert screen_extended(extended, LEFT_OUT).groups is not screening.groups


def test_effects_that_need_a_second_session_are_absorbed_in_a_single_one(screening: Screening) -> None:
    limits = detectability_of(screening, select_effects(screening, np.random.default_rng(0)))
    of_sessions = {name for name, missing in limits.not_looked_for if missing is Missing.SECOND_SESSION}
    assert of_sessions
    assert of_sessions <= {effect.name for effect in limits.absorbed}
