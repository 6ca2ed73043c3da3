"""Discovering what a model lacks, in six steps: fit, locate, propose, select, confirm, conclude."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Dataset
from omnibench.discover.conclude import conclude
from omnibench.discover.confirm import confirm
from omnibench.discover.fit import fit_plain, start_matrix
from omnibench.discover.locate import locate
from omnibench.discover.propose import propose
from omnibench.discover.result import Discovery
from omnibench.discover.select import select
from omnibench.errors import computable, require_type
from omnibench.progress import Reporter, Stages, no_progress
from omnibench.registry import effects
from omnibench.robot.calibration import Calibration


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
    for name in without:
        effects.entry(name, "without")
    start = start_matrix(dataset, calibration)
    began, progress, rng = time.monotonic(), Stages(watch), np.random.default_rng(seed)

    progress.begin("fitting the plain matrix")
    plain = fit_plain(dataset, start)

    progress.begin("locating what it leaves")
    located = locate(plain, without, rng)

    progress.begin("proposing effects that these recordings can show")
    proposal = propose(located)

    progress.begin("selecting those that explain it")
    selected = select(proposal, rng)

    progress.begin("confirming them on runs that were held out")
    confirmed = confirm(selected, rng, unknown_term=unknown_term)

    progress.begin("concluding, and choosing what to drive next")
    options = {"without": list(without), "unknown_term": unknown_term}
    discovery = conclude(confirmed, {"options": options, "seed": seed})

    progress.end()
    return replace(discovery, seconds=time.monotonic() - began)
