"""Proven lower bounds: how far below the runs of a comparison any optimiser could get, box by box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.compare.plan import PlannedRun
from omnibench.compare.result import BoxCertificate, ScoredRun
from omnibench.compare.scoring import is_comparable
from omnibench.fit.certify import prove, proven_gap
from omnibench.fit.cost import SumOfNorms
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch


def certify(
    plan: Sequence[PlannedRun], scored: Sequence[ScoredRun]
) -> tuple[tuple[ScoredRun, ...], tuple[BoxCertificate, ...]]:
    """The runs with their proven gaps, and one proof for each box of matrix elements in which a run gave an answer.

    A geometry, or an answer without a box, is compared with a box that contains its matrix. Nothing is proven where the
    config asks for no certificate, the cost is no sum of norms, or references are no poses: no bound is known then.
    """
    proofs: list[tuple[PlannedRun, BoxCertificate]] = []
    for run, done in zip(plan, scored, strict=True):
        wanted = run.config.certificate is not None and run.element_box is not None and done.matrix is not None
        if wanted and not any(_same_box(run, owner) for owner, _ in proofs):
            answers = [
                other.matrix.ravel()
                for planned, other in zip(plan, scored, strict=True)
                if other.matrix is not None and planned.dataset_name == run.dataset_name
            ]
            proofs += [(run, proof) for proof in _proof(run, answers)]
    return (
        tuple(_with_proven_gap(run, done, proofs) for run, done in zip(plan, scored, strict=True)),
        tuple(proof for _, proof in proofs),
    )


def _same_box(run: PlannedRun, other: PlannedRun) -> bool:
    return run.dataset_name == other.dataset_name and run.element_box == other.element_box


def _proof(run: PlannedRun, answers: Sequence[Array]) -> list[BoxCertificate]:
    """The lower bound over a run's box, if its cost has one. Good answers (3N,) that are known make it faster."""
    choice = run.config.certificate
    problem = run.task.problem()
    posed = isinstance(problem.odometry, OdometryBatch)
    if choice is None or not posed or not isinstance(problem.objective, SumOfNorms):
        return []
    known = np.stack([problem.start, *answers])
    inside = known[problem.inside(known)]
    best = inside[int(np.nanargmin(problem.values(inside)))]
    proof = prove(problem, best, gap=choice.gap, seconds=choice.seconds, parts=choice.parts)
    return [
        BoxCertificate(
            dataset=run.dataset_name,
            box=run.box_name,
            lower_bound=proof.lower_bound,
            best_cost=proof.best_cost,
            gap=proven_gap(proof.best_cost, proof.lower_bound),
            parts=proof.boxes,
            seconds=proof.seconds,
            finished=proof.finished,
        )
    ]


def _with_proven_gap(
    run: PlannedRun, done: ScoredRun, proofs: Sequence[tuple[PlannedRun, BoxCertificate]]
) -> ScoredRun:
    cost, matrix = done.record.train_cost, done.matrix
    if cost is None or matrix is None or done.extension is not None:  # no matrix of a box has effects
        return done
    for owner, proof in proofs:
        if is_comparable(run, matrix, owner):
            gap = proven_gap(cost, proof.lower_bound)
            return replace(done, record=done.record.model_copy(update={"proven_gap": gap}))
    return done
