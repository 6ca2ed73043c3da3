"""Certificate of optimality: a proven bound on how much better than a calibration any matrix in a box could be.

Branch and bound on the matrix elements (Horst and Tuy, Global Optimization, 1996, ch. IV): the parts P that the box is
cut into have the bounds b(P) of bounds/lower_bound.py, and M is the best matrix that is known. At any time

    min over P of b(P)  <=  least cost in the box  <=  F(M)                                        (C1)
    gap = 1 - min b(P) / F(M).                                                                     (C2)

The part with the lowest bound, which alone can raise the minimum, is cut in two until the gap is as small as wanted.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.data.splits import training_split
from omnibench.errors import DataError, require_choice, require_range, require_type
from omnibench.fit.bounds.lower_bound import LowerBounds, Node
from omnibench.fit.bounds.stamp_sums import QUADRATURE
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.parameterisation import Box, BoxName, ExplicitBox
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.jobs.gathering import gathered
from omnibench.jobs.job import Backend
from omnibench.processes import one_thread
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.views import Brief

_TIMED = 3  # parts whose mean time stands for that of all: the whole box and its first two parts
# Parts of proofs to a gap of 0.1 %: the median and the fewest of twelve of simulated data (61 to 379), and the 901 of
# the real omni3 in the box paper. A tenth of the gap takes about twice as many (tests/studies/proof_parts.py).
_PARTS, _FEW_PARTS, _MANY_PARTS = 150, 60, 900
_PARTS_GAP = 1e-3
# Parts that are cut at once by a backend, and how often each, however many workers it has: a cut takes 10 to 20 ms, to
# send what it needs as much again (chosen).
_AT_ONCE, _CUTS = 8, 32


@dataclass(frozen=True, eq=False, repr=False)
class Proof(Brief):
    """State of the branch and bound: no matrix of the box costs less than ``lower_bound``.

    best_cost, best_vector (n,): the best matrix that is known. boxes: number of parts bounded so far. finished: False
    when time or parts ran out.
    """

    lower_bound: float
    best_cost: float
    best_vector: Array
    boxes: int
    seconds: float
    finished: bool


class Certificate(Model):
    """Largest possible distance of a calibration's cost from the optimum: ``gap`` = 1 - lower_bound / cost.

    cost: on the training split; of a calibration that was shrunk to the design, that of the optimum before.
    lower_bound: no matrix in the box costs less. shrinking: share that shrinking adds to that optimum's cost; None for
    a calibration that was not shrunk.
    """

    cost: float
    lower_bound: float
    gap: float
    box: str
    seconds: float
    shrinking: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class CertifiedCalibration(Brief):
    """A certificate with its proof. inside: True if the calibration lies in the box. held: names of fixed elements."""

    certificate: Certificate
    proof: Proof
    cost_name: str
    dataset: Dataset
    inside: bool
    held: tuple[str, ...]


def certify_optimum(
    calibration: Calibration,
    dataset: Dataset,
    *,
    box: Box | None = None,
    gap: float = 1e-3,
    seconds: float = 60.0,
    parts: int | None = None,
    watch: Reporter = no_progress,
    backend: Backend | None = None,
) -> CertifiedCalibration:
    """Bound how much better than a calibration any matrix of the box could be, on a data set's training split.

    Cost and integration are those of the calibration. Of one that was shrunk to the design, the unshrunk optimum is
    certified, found anew, and what shrinking costs is said. box: default the one that was searched, or ``row``.
    watch: told early about how long the proof takes, then of every part.
    gap: stop when the best known matrix is proven to be this close to the optimum. seconds, parts: stop after this time
    or after so many parts of the box; the number ends a proof at the same place on every machine. backend: bounds parts
    as jobs, several at once; the proof is then the same on every backend, and has other parts than without one.
    Raises DataError when the wheels differ, the calibration has effects or was fitted with a robust loss, or the
    training split is empty, ConfigError for a cost that is no sum of norms.
    """
    require_type(calibration, Calibration, "read_calibration")
    require_type(dataset, Dataset, "load_dataset")
    if not (box is None or isinstance(box, ExplicitBox)):
        require_choice("box", box, get_args(BoxName))
    require_range("gap", gap, 0, 1)
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    if calibration.effects:
        named = ", ".join(term.name for term in calibration.effects)
        raise DataError(
            f"calibration {calibration.name!r} has effects ({named}), and a bound is proven for a matrix alone; "
            "certify the calibration without them"
        )
    provenance = calibration.provenance
    if provenance is not None and provenance.loss is not None:
        raise DataError(
            f"calibration {calibration.name!r} was fitted with the loss {provenance.loss}, and a bound is proven for a "
            "cost without one; certify a calibration that was fitted without --loss"
        )
    searched = provenance.box if provenance else ""
    chosen: Box = box or ("paper" if searched == "paper" else "row")
    training = training_split(dataset)
    problem = CalibrationProblem(
        dataset.robot,
        training,
        costs.create(provenance.cost if provenance else "final_pose"),
        make_parameterisation(
            "matrix", dataset.robot, training, box=chosen, mount=provenance.mount if provenance else "known"
        ),
        integration=calibration.integration,
        budget=Budget(),
        seed=0,
    )
    vector = calibration.matrix_array.ravel()
    cost = float(problem.values(vector[None])[0])
    inside = bool(problem.inside(vector[None])[0])
    shrinking = None
    if provenance is not None and provenance.unidentified == "shrink":
        optimum = run_calibrator(calibrators.create("closed_form"), problem)
        if optimum.vector is None or optimum.cost is None:
            raise DataError(f"calibration {calibration.name!r}: its unshrunk optimum is not found: {optimum.reason}")
        if optimum.cost > problem.objective.rounding:  # no share of rounding means anything
            vector, inside, shrinking, cost = optimum.vector, True, cost / optimum.cost - 1, optimum.cost
    began = time.perf_counter()

    def foretell(event: Progress) -> None:
        watch(event)
        if event.done == _TIMED and (parts or math.inf) > _TIMED and gap > 0:  # to a gap of 0 the limits end it
            each = (time.perf_counter() - began) / _TIMED
            watch(Progress("duration", result=_duration_in_words(gap, each, seconds, parts)))

    known = vector if inside else problem.start
    proof = prove(problem, known, gap=gap, seconds=seconds, parts=parts, watch=foretell, backend=backend)
    return CertifiedCalibration(
        Certificate(
            cost=cost,
            lower_bound=proof.lower_bound,
            gap=proven_gap(cost, proof.lower_bound),
            box=problem.box,
            seconds=proof.seconds,
            shrinking=shrinking,
        ),
        proof,
        problem.objective.name,
        dataset,
        inside,
        problem.held,
    )


def proven_gap(cost: float, lower_bound: float) -> float:
    """Largest share of a cost that could be saved; negative for a matrix outside the box that beats the bound.

    0 for a cost that no bound can see: it is rounding.
    """
    return 1 - lower_bound / cost if cost >= QUADRATURE else 0.0


def prove(
    problem: CalibrationProblem,
    known: Array,
    *,
    gap: float = 1e-3,
    seconds: float = 60.0,
    parts: int | None = None,
    watch: Reporter = no_progress,
    backend: Backend | None = None,
) -> Proof:
    """A lower bound of the cost over the problem's box, within ``gap`` of the best cost known unless the limits end it.

    known (n,): a good vector in the box. seconds, parts, backend: as in certify_optimum. ConfigError when the problem
    has no such bound (see LowerBounds).
    """
    began = time.perf_counter()
    with one_thread():
        bounds = LowerBounds(problem)
        count, order = 1, 0
        best_cost, best_vector = float(problem.values(known[None])[0]), known
        root = bounds.root(known)
        boxes: list[tuple[float, int, Node]] = [(root.bound, 0, root)]
        while True:
            lowest, _, node = boxes[0]
            proven = min(lowest, best_cost)  # Eq. (C1)
            spent = time.perf_counter() - began
            closed = proven >= (1 - gap) * best_cost or best_cost < QUADRATURE  # Eq. (C2); no bound sees less
            finished = closed or not node.looseness.any()
            proof = Proof(proven, best_cost, best_vector, count, spent, finished)
            watch(Progress("proof", count, None, "part", best_cost, f"bound {proven:.6f}"))
            if finished or spent > seconds or count >= (parts or math.inf):
                return proof
            if backend is None:
                cut, made = [*bounds.split(heapq.heappop(boxes)[2])], 2
            else:
                cut, made = _cut_at_once(boxes, bounds, (1 - gap) * best_cost, (parts or math.inf) - count, backend)
            for part in cut:
                vector = bounds.vector(part.good)
                if problem.inside(vector[None])[0] and (cost := float(problem.values(vector[None])[0])) < best_cost:
                    best_cost, best_vector = cost, vector
                order += 1
                heapq.heappush(boxes, (part.bound, order, part))  # order breaks ties: nodes cannot be compared
            count += made


def _cut_at_once(
    boxes: list[tuple[float, int, Node]], bounds: LowerBounds, wanted: float, left: float, backend: Backend
) -> tuple[list[Node], int]:
    """Take the lowest parts and cut each as a job: the parts that they become, and how many were bounded for that.

    wanted: bound from which on a part needs no cut. left: parts that may still be bounded.
    """
    taken = [heapq.heappop(boxes)[2]]
    while boxes and len(taken) < _AT_ONCE and boxes[0][0] < wanted and boxes[0][2].looseness.any():
        taken.append(heapq.heappop(boxes)[2])
    cuts = _CUTS if math.isinf(left) else int(min(_CUTS, max(left // (2 * len(taken)), 1)))
    branches = gathered(backend, _branch, [(bounds, node, wanted, cuts) for node in taken], shared=(bounds,))
    return [node for branch in branches for node in branch.nodes()], sum(branch.made for branch in branches)


@dataclass(frozen=True, eq=False)
class _Branch:
    """The parts (P) that a node was cut into: deviations, good matrices, loosenesses (P, 3, r) and bounds (P,).

    made: parts that were bounded on the way.
    """

    lower: Array
    upper: Array
    good: Array
    looseness: Array
    bound: Array
    made: int

    def nodes(self) -> Iterator[Node]:
        """The parts."""
        fields = (self.lower, self.upper, self.bound, self.good, self.looseness)
        for low, high, bound, good, loose in zip(*fields, strict=True):
            yield Node(low, high, float(bound), good, loose)


def _branch(order: tuple[LowerBounds, Node, float, int], _: Reporter) -> _Branch:
    """Cut a node in a job, its lowest part first, until all bounds reach the wanted one, or so many times."""
    bounds, node, wanted, cuts = order
    boxes, made = [(node.bound, 0, node)], 0
    while made < 2 * cuts and boxes[0][0] < wanted and boxes[0][2].looseness.any():
        for part in bounds.split(heapq.heappop(boxes)[2]):
            made += 1
            heapq.heappush(boxes, (part.bound, made, part))
    parts = [part for _, _, part in boxes]
    names = ("lower", "upper", "good", "looseness", "bound")
    return _Branch(**{name: np.array([getattr(part, name) for part in parts]) for name in names}, made=made)


def _duration_in_words(gap: float, each: float, seconds: float, parts: int | None) -> str:
    """How long a proof takes that examines a part in ``each`` s, and when it ends at the latest."""
    growth = 2 ** math.log10(_PARTS_GAP / gap)
    about, least, most = (growth * number for number in (_PARTS, _FEW_PARTS, _MANY_PARTS))
    limits = [f"{seconds:g} s"] * math.isfinite(seconds) + [f"{parts} parts"] * (parts is not None)
    words = (
        f"a proof to within {gap:.3g} of the cost takes about {each * about:.2g} s here ({each * least:.2g} to "
        f"{each * most:.2g} s: {least:.0f} to {most:.0f} parts at {each:.2g} s)"
    )
    return f"{words}; it ends after {' or '.join(limits)} at the latest" if limits else words
