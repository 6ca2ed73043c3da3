"""Discovering what a model lacks: fit, look, name, extend, compare. The whole way on one page."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from omnibench.data.dataset import Dataset
from omnibench.discover.calibrations import Request
from omnibench.discover.conclude import told
from omnibench.discover.fitting.extend import Extended, extend
from omnibench.discover.fitting.model_fit import Fit, fit_matrix
from omnibench.discover.fitting.usable_runs import usable_runs
from omnibench.discover.result import Discovery
from omnibench.discover.selection.candidate_groups import check_names
from omnibench.discover.selection.competing_models import rivals_of
from omnibench.discover.selection.motor_effects import look_at_actuators
from omnibench.discover.selection.screening import Look, look_at
from omnibench.errors import DataError
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array

_EXPLAINED = 0.5  # of what slopes left: when more is left by the effects themselves, they are wrong


class Watch(Protocol):
    """Who wants to know how far it is."""

    def stage(self, text: str) -> None:
        """What is being done now."""


class _Nobody:
    def stage(self, text: str) -> None:
        pass


def discover_effects(
    dataset: Dataset,
    *,
    without: Sequence[str] = (),
    unknown_term: bool = False,
    seed: int = 0,
    watch: Watch | None = None,
    calibration: Calibration | None = None,
) -> Discovery:
    """Find where the odometry of a data set's training split disagrees with its reference, and name what is missing.

    without: effects that are not to be tried. unknown_term: where nothing has a name, add a smooth term over what was
    located. calibration: whose matrix to begin at. The validation split is looked at when all is decided, and only to
    say how well that predicts it.

    Raises UnknownNameError for a name in ``without`` that is no effect's, DataError for a training split without
    reference poses or another robot's calibration.
    """
    began, tell = time.monotonic(), watch or _Nobody()
    check_names(without)
    rng = np.random.default_rng(seed)
    runs = usable_runs(dataset.split("train"))
    start = _start(dataset, calibration)
    tell.stage("fitting the plain matrix")
    plain = fit_matrix(runs, dataset.robot, dataset.sample_period, start)
    tell.stage("looking where it fails, and at the catalogue")
    look = look_at(plain, None, None, without, rng)
    extended = extend(plain, look.named.chosen)
    if look.named.tentative:
        look, extended = _beyond_slopes(plain, look, extended, without, rng)
    if look.named.chosen:
        tell.stage("looking again, now that the noise is known better")
        again = look_at(extended.fit, extended, look.groups, without, rng)
        if not again.named.is_same_as(look.named):
            extended = extend(plain, again.named.chosen)
        look = again
    rivals = rivals_of(plain, look, extended)
    tell.stage("looking at the motors")
    motors = look_at_actuators(runs, dataset.robot, without, rng)
    tell.stage("comparing on runs that were held out")
    return told(dataset, plain, look, rivals, motors, Request(tuple(without), unknown_term, seed), began)


def _beyond_slopes(
    plain: Fit, look: Look, extended: Extended, without: Sequence[str], rng: np.random.Generator
) -> tuple[Look, Extended]:
    """A second look with the names that were given up fitted in full, which stands if that explains what was left.

    Where an effect is many times as large as the noise, its slopes alone leave what another effect would.
    """
    tried = extend(plain, look.named.tentative)
    again = look_at(tried.fit, tried, None, without, rng)
    if again.named.chosen and again.named.left_share < _EXPLAINED * look.named.left_share:
        return again, tried
    return look, extended


def _start(dataset: Dataset, calibration: Calibration | None) -> Array:
    """The matrix (3, N) to begin at."""
    if calibration is None:
        return dataset.robot.inverse_kinematic_matrix
    if calibration.effects:
        held = ", ".join(term.name for term in calibration.effects)
        raise DataError(
            f"the calibration {calibration.name!r} holds effects already ({held}), and discover begins at a plain "
            "matrix; give one without effects, such as the plain.yaml beside it, or none"
        )
    if calibration.robot.wheel_names != dataset.robot.wheel_names:
        ours, theirs = ", ".join(calibration.robot.wheel_names), ", ".join(dataset.robot.wheel_names)
        raise DataError(f"the calibration is for wheels {ours}, the data set {dataset.name} has {theirs}")
    return calibration.matrix_array
