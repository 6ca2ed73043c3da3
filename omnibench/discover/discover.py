"""Discovering what a model lacks: all steps, in their order.

Fit the plain matrix; screen its residuals for all that could explain them; select the effects of the catalogue that do;
extend the model by these; confirm them once the noise is known better; compare plain and extended model on runs that
were held out; conclude.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Dataset
from omnibench.discover.conclude import Findings, Request, conclude, lacks_a_name, verdict_of
from omnibench.discover.covariate_dependence import covariate_dependences, without_smooth_term
from omnibench.discover.experiments import experiments_for
from omnibench.discover.fitting import Extended, Fit, extend, fit_matrix, in_windows, without_effects
from omnibench.discover.held_out import (
    compare_held_out,
    compare_with_validation,
    eq6_with_changes,
    extrapolations_of,
    faded,
    noise_runs,
    random_folds_of_repetitions,
    validation_runs,
    waterfall_steps,
)
from omnibench.discover.regressors.fine_structure import fine_structure
from omnibench.discover.regressors.significance import Significance, together
from omnibench.discover.result import Discovery
from omnibench.discover.selection.competing_models import averaged, competing_models, named_effects, with_fitted_forms
from omnibench.discover.selection.detectability import detectability_of
from omnibench.discover.selection.evidence import check_names
from omnibench.discover.selection.model_selection import Selection, select_effects
from omnibench.discover.selection.motor_effects import select_motor_effects
from omnibench.discover.selection.screening import (
    Screening,
    screen_again,
    screen_extended,
    screen_plain,
    significance_left,
)
from omnibench.discover.selection.unknown_term import add_smooth_terms
from omnibench.errors import DataError, computable, require_type
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.progress import Reporter, Stages, no_progress
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array

# Effects that the first selection gave up are kept if, once they are fitted in full, less than this share of the
# chi-square that they left to first order remains. tests/studies/constants.py varies it by 0.5 and 2, and no verdict
# changes.
_EXPLAINED = 0.5


@computable
def discover_effects(
    dataset: Dataset,
    *,
    without: Sequence[str] = (),
    unknown_term: bool = True,
    seed: int = 0,
    watch: Reporter = no_progress,
    calibration: Calibration | None = None,
) -> Discovery:
    """Find where the odometry of a data set's training split disagrees with its reference, and which effect is missing.

    without: effects that are not to be tried. unknown_term: where no name is sure, close the gap by a term without a
    name, over the covariate that the residuals depend on. calibration: the plain matrix is fitted from this one's
    matrix on, by default from the robot's design values. The validation split is used when all is decided, and only to
    say how well the models predict it; but where no session of the training split repeats a command, runs of the
    validation split that do are used for the noise, and a note says so. watch: told of every step as it begins and
    ends.

    Raises UnknownNameError for a name in ``without`` that is no effect's, DataError for a training split without
    reference poses or another robot's calibration.
    """
    require_type(dataset, Dataset, "load_dataset")
    if calibration is not None:
        require_type(calibration, Calibration, "read_calibration")
    began, progress = time.monotonic(), Stages(watch)
    check_names(without)
    rng = np.random.default_rng(seed)
    runs = usable_runs(in_windows([run for run in dataset.split("train") if run.has_poses]) or dataset.split("train"))
    start = _start_matrix(dataset, calibration)

    progress.begin("fitting the plain matrix")
    plain = fit_matrix(runs, dataset.robot, dataset.sample_period, start, noise_runs(runs, dataset))

    screening, selection, extended = _select(plain, without, rng, progress)
    models = competing_models(plain, selection, extended)
    models = with_fitted_forms(plain, screening, models)
    baseline = without_effects(plain, models.used)
    selection = located(models.selection, screening, baseline, models.used, rng)

    progress.begin("looking at the motors")
    motors = select_motor_effects(runs, dataset.robot, without, rng)

    dependences = covariate_dependences(screening, selection, motors)
    effects = named_effects(models, motors)
    verdict = verdict_of(effects, dependences.where, dependences.left)
    folds = random_folds_of_repetitions(runs, rng)
    term_notes: tuple[str, ...] = ()
    if unknown_term and lacks_a_name(verdict):
        progress.begin("closing the gap without a name")
        smooth = add_smooth_terms(
            plain, screening, models, selection.left, lambda model: all_left(model, screening, rng), folds
        )
        if smooth.models is not models:
            dependences = without_smooth_term(dependences, smooth.left, screening, selection)
        models, term_notes = smooth.models, smooth.notes
        effects = named_effects(models, motors)

    progress.begin("comparing on runs that were held out")
    average = averaged(models.weighted)
    baseline = without_effects(plain, average.extended)
    extended = faded(average.extended, baseline)
    validation = validation_runs(dataset, extended.fit)
    held_out = compare_held_out(baseline, extended, validation, folds)
    steps = waterfall_steps(plain, baseline, models.used, extended, validation)
    sessions = compare_with_validation(extended, validation)
    eq6_of_sessions = eq6_with_changes(extended, validation.runs, sessions)
    extrapolations = extrapolations_of(validation.runs, baseline, extended, average.members)
    detectability = detectability_of(screening, models.selection)

    if any(effect.confusable_with for effect in effects):
        progress.begin("choosing runs that tell the look-alikes apart")
    experiments = experiments_for(dataset, effects, models.weighted)

    findings = Findings(
        screening=screening,
        selection=selection,
        effects=effects,
        dependences=dependences,
        verdict=verdict,
        term_notes=(*term_notes, *filter(None, [average.note])),
        baseline=baseline,
        extended=extended,
        validation=validation,
        held_out=held_out,
        steps=steps,
        extrapolations=extrapolations,
        detectability=detectability,
        experiments=experiments,
        sessions=sessions,
        eq6_of_sessions=eq6_of_sessions,
    )
    progress.end()
    request = Request(tuple(without), unknown_term, seed)
    return conclude(dataset, request, findings, time.monotonic() - began)


def _select(
    plain: Fit, without: Sequence[str], rng: np.random.Generator, progress: Stages
) -> tuple[Screening, Selection, Extended]:
    """Screen the plain matrix, select the effects that explain its residuals, and extend the model by them."""
    progress.begin("looking where it fails, and at the catalogue")
    screening = screen_plain(plain, without)
    selection = select_effects(screening, rng)
    extended = extend(plain, selection.chosen)
    if selection.tentative:
        # Effects that were given up are fitted in full, and kept if most of what they left is then explained: to first
        # order, an effect many times as large as the noise leaves residuals that look like another effect.
        in_full = extend(plain, selection.tentative)
        screened_in_full = screen_extended(in_full, without)
        again = select_effects(screened_in_full, rng)
        if again.chosen and again.left_share < _EXPLAINED * selection.left_share:
            screening, selection, extended = screened_in_full, again, in_full
    if selection.chosen:
        progress.begin("looking again, now that the noise is known better")
        before = selection
        screening = screen_again(extended, screening)
        selection = select_effects(screening, rng)
        if not selection.is_same_as(before):
            extended = extend(plain, selection.chosen)
    return screening, selection, extended


def _start_matrix(dataset: Dataset, calibration: Calibration | None) -> Array:
    """The matrix (3, N) to begin at. Raises DataError for a calibration that has effects or other wheels."""
    if calibration is None:
        return dataset.robot.inverse_kinematic_matrix
    if calibration.effects:
        names = ", ".join(term.name for term in calibration.effects)
        raise DataError(
            f"the calibration {calibration.name!r} holds effects already ({names}), and discover begins at a plain "
            "matrix; give one without effects, such as the plain.yaml beside it, or none"
        )
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    return calibration.matrix_array


def located(
    selection: Selection,
    screening: Screening,
    baseline: Extended,
    extended: Extended,
    rng: np.random.Generator,
) -> Selection:
    """The selection with all that the residuals depend on, before any effect and after those of an extended model.

    baseline: the plain matrix under the noise of the extended model.
    """
    where = together(selection.where, fine_structure(baseline.fit, rng))
    return replace(selection, where=where, left=all_left(extended, screening, rng) if extended.groups else where)


def all_left(extended: Extended, screening: Screening, rng: np.random.Generator) -> Significance:
    """Significance of generic bases and of fine structure beyond all that an extended model holds."""
    bases = significance_left(extended, screening, rng)
    return together(bases, fine_structure(extended.fit, rng))
