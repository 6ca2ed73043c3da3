"""Closing the gap without a name: on recordings with something in them that no catalogue has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from discovery_samples import nothing, plain_fit, simulated
from hidden.experiment import ROBOT
from hidden.sets import Truth, make_set

from omnibench.data.dataset import Dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.fitting import Extended, extend
from omnibench.discover.held_out import group_counts, step_name
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.significance import Group
from omnibench.discover.result import Discovery
from omnibench.discover.selection.competing_models import CompetingModels
from omnibench.discover.selection.model_selection import Selection, select_effects
from omnibench.discover.selection.screening import Screening, screen_plain
from omnibench.discover.selection.unknown_term import add_smooth_terms, chosen_functions
from omnibench.fit.noise import Whitener
from omnibench.registry import effects
from omnibench.robot.calibration import Calibration, read_calibration, write_calibration

FOLDS = np.tile(np.arange(5), 12)  # of the 60 runs of a small set


def recorded(kind: str) -> tuple[Dataset, Truth]:
    """60 + 60 runs with an effect that no catalogue has, of a non-centrality of 600."""
    return make_set("outside", kind, 600.0, 1000, design="small")


def left_out() -> Discovery:
    return discover_effects(simulated(), without=("rotation_translation_coupling",), unknown_term=False)


@pytest.fixture(scope="module")
def grooved() -> tuple[Dataset, Truth, Discovery]:
    dataset, truth = recorded("turning_by_heading")
    return dataset, truth, discover_effects(dataset)


@pytest.fixture(scope="module")
def bare(grooved: tuple[Dataset, Truth, Discovery]) -> Extended:
    """Their plain fit."""
    return extend(plain_fit(grooved[0]), ())


@pytest.fixture(scope="module")
def screened(bare: Extended) -> tuple[Screening, Selection]:
    """Their screening, and what is selected after it."""
    screening = screen_plain(bare.fit, ())
    return screening, select_effects(screening, np.random.default_rng(0))


def error(calibration: Calibration, dataset: Dataset, truth: Truth, found: Discovery) -> float:
    """Whitened chi2 of a calibration against the poses of the validation without their noise."""
    true = {run.id: run for run in truth.clean}
    runs = dataset.split("validation")
    logs = [replace(run.reference_log, start=true[run.id].poses[0]) for run in runs]
    return sum(
        float(np.square(Whitener(found.noise.noise, run.pose_times[1:])(true[run.id].poses[1:] - poses)).sum())
        for run, poses in zip(runs, calibration.model.reported(logs), strict=True)
    )


def test_most_of_the_gap_closes_on_a_held_out_session_by_a_step_without_a_name(
    grooved: tuple[Dataset, Truth, Discovery],
) -> None:
    dataset, truth, found = grooved
    before, after = (error(each, dataset, truth, found) for each in (found.plain, found.extended))
    assert after < 0.25 * before
    assert (found.verdict, found.effects) == ("unknown", ())
    assert {term.name for term in found.extended.effects} <= {"smooth_heading", "smooth_course", "smooth_heading_wave"}
    assert [step.name for step in found.steps] == ["plain matrix", "+ unnamed, over heading"]
    first, last = (step.held_out for step in found.steps)
    assert first is not None
    assert last is not None
    assert last < first
    assert len([note for note in found.notes if "unnamed term" in note]) == 1


def test_the_calibration_file_predicts_the_same(grooved: tuple[Dataset, Truth, Discovery], tmp_path: Path) -> None:
    dataset, _, found = grooved
    write_calibration(found.extended, tmp_path / "extended.yaml")
    log = dataset.split("validation")[0].reference_log
    again = read_calibration(tmp_path / "extended.yaml").model.reported([log])[0]
    np.testing.assert_array_equal(again, found.extended.model.reported([log])[0])


@pytest.mark.parametrize("make", [left_out, nothing])
def test_no_term_is_tried_where_it_is_not_wanted_or_nothing_is_missing(make: Callable[[], Discovery]) -> None:
    found = make()
    assert found.verdict == ("none" if make is nothing else "unknown")
    assert found.extended.effects == ()
    assert not any("unnamed" in note for note in found.notes)


def test_of_two_waves_the_one_that_is_there_is_chosen() -> None:
    base = extend(plain_fit(recorded("oval_wheel")[0]), ())
    found = chosen_functions(base, [group("smooth_wheel_angle", harmonic=3.5), group("smooth_wheel_angle", harmonic=2)])
    largest = max(found, key=lambda each: len(each.parameters))
    assert largest.shapes["harmonic"] == 2


def test_functions_that_are_not_chosen_are_zero(bare: Extended) -> None:
    (found,) = chosen_functions(bare, [group("smooth_heading")])
    chosen = {each.name for each in found.parameters}
    assert chosen & {"turn_cos2", "turn_sin2"}  # what is there
    every = {each.name for each in effects.create("smooth_heading").parameters(ROBOT)}
    assert found.shapes == dict.fromkeys(every - chosen, 0.0)


def test_functions_are_fitted_together_with_named_effects_and_stand_after_them(
    bare: Extended, screened: tuple[Screening, Selection]
) -> None:
    screening, selection = screened
    models = with_names(bare, selection, group("heading_drift"))
    smooth = add_smooth_terms(bare.fit, screening, models, selection.where, lambda _: selection.left, FOLDS)
    used = smooth.models.used
    assert used.groups[0].name == "heading_drift"
    assert {each.name for each in used.groups[1:]} <= {"smooth_heading", "smooth_course", "smooth_heading_wave"}
    assert smooth.models.weighted[0][1] is used
    assert "unnamed" in smooth.notes[0]
    calibrated = calibration_terms(used)
    assert calibrated["heading_drift"]["b"] == used.values[0]


@pytest.mark.slow
def test_runs_of_few_kinds_of_motion_get_no_term(grooved: tuple[Dataset, Truth, Discovery]) -> None:
    dataset = grooved[0]
    commands = sorted({run.command or "" for run in dataset.trajectories})[:9]
    few = replace(dataset, trajectories=tuple(run for run in dataset.trajectories if run.command in commands))
    found = discover_effects(few)
    assert found.verdict == "unknown"
    assert found.extended.effects == ()
    assert any("No unnamed term was tried: 9 kinds of motion" in note for note in found.notes)


def test_nothing_is_added_to_a_model_that_leaves_nothing_of_it(
    bare: Extended, screened: tuple[Screening, Selection]
) -> None:
    screening, selection = screened
    models = with_names(bare, selection, group("smooth_heading"), group("smooth_course"))
    smooth = add_smooth_terms(bare.fit, screening, models, selection.where, lambda _: selection.left, FOLDS)
    assert smooth.models is models
    assert "unnamed term" in smooth.notes[0]
    assert "was added" in smooth.notes[0] or "left out" in smooth.notes[0]


def test_named_effects_come_one_by_one_and_what_has_no_name_at_once() -> None:
    basis = Basis("place", "body", "where on the floor the robot is")
    named, nameless = group("heading_drift"), replace(group("smooth_place"), basis=basis)
    assert group_counts([named, named, nameless, nameless]) == [1, 2, 4]
    assert group_counts([named]) == [1]
    assert group_counts([]) == []
    assert step_name(nameless) == "unnamed, over place"


def with_names(bare: Extended, selection: Selection, *groups: Group) -> CompetingModels:
    """A model with these effects, whatever was selected."""
    used = extend(bare.fit, groups)
    return CompetingModels(used, selection, ((1.0, used),), ())


def calibration_terms(extended: Extended) -> dict[str, dict[str, float]]:
    return {term.name: dict(term.values) for term in extended.fit.model.terms}


def group(name: str, **shapes: float) -> Group:
    effect = effects.create(name)
    parameters = effect.parameters(ROBOT)
    linear = tuple(each for each in parameters if not each.choices)
    usual = {each.name: each.choices[0] for each in parameters if each.choices}
    return Group("effect", name, (), effect, linear, usual | shapes)
