"""How much lower any optimiser could get than the runs of a comparison: one proof for each box that was searched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.compare.plan import PlannedRun
from omnibench.compare.result import BoxCertificate, ScoredRun
from omnibench.compare.run_problem import make_problem
from omnibench.compare.scoring import box_contains, box_of, has_no_box
from omnibench.fit.certify import prove, proven_gap
from omnibench.fit.cost import SumOfNorms


def certify(
    plan: Sequence[PlannedRun], scored: Sequence[ScoredRun]
) -> tuple[tuple[ScoredRun, ...], tuple[BoxCertificate, ...]]:
    """The runs with what share of their cost any matrix of their box could save at most, and the proofs behind it.

    A geometry, or an answer without a box, is held against a box that contains its matrix. Nothing is proven where the
    config does not want it, or the cost is no sum of norms, of which no bound is known.
    """
    proofs: list[tuple[PlannedRun, BoxCertificate]] = []
    for run, done in zip(plan, scored, strict=True):
        wanted = run.config.certificate is not None and not has_no_box(run) and done.matrix is not None
        if wanted and not any(_same_box(run, owner) for owner, _ in proofs):
            rivals = zip(plan, scored, strict=True)
            answers = [r.matrix for other, r in rivals if r.matrix is not None and _shares_data(run, other)]
            proofs += [(run, proof) for proof in _proof(run, [matrix.ravel() for matrix in answers])]
    return (
        tuple(_with_proven_gap(run, done, proofs) for run, done in zip(plan, scored, strict=True)),
        tuple(proof for _, proof in proofs),
    )


def _proof(run: PlannedRun, answers: Sequence[np.ndarray]) -> list[BoxCertificate]:
    """The lower bound over a run's box, if its cost has one; the better the known answers, the sooner."""
    choice = run.config.certificate
    problem = make_problem(run.config, run.entry, run.dataset.robot, run.dataset.split("train"), "matrix")
    if choice is None or not isinstance(problem.objective, SumOfNorms):
        return []
    known = np.stack([problem.start, *answers])
    inside = known[problem.inside(known)]
    best = inside[int(np.nanargmin(problem.values(inside)))]
    proof = prove(problem, best, gap=choice.gap, seconds=choice.seconds)
    return [
        BoxCertificate(
            dataset=run.dataset_name,
            box=run.box,
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
    if cost is None or matrix is None:
        return done
    for owner, proof in proofs:
        if _shares_data(run, owner) and (
            box_contains(owner, matrix) if has_no_box(run) else box_of(owner) == box_of(run)
        ):
            gap = proven_gap(cost, proof.lower_bound)
            return replace(done, record=done.record.model_copy(update={"proven_gap": gap}))
    return done


def _shares_data(run: PlannedRun, other: PlannedRun) -> bool:
    return run.dataset_name == other.dataset_name


def _same_box(run: PlannedRun, other: PlannedRun) -> bool:
    return _shares_data(run, other) and box_of(run) == box_of(other)
