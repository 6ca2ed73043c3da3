"""Intervals: a jackknife over clusters of runs, Student's t, and the prior's own part.

What an estimate has minimised is a sum over clusters of runs, and perhaps a prior's part. With a cluster's slope g_c
and Hessian H_c at the minimum, and the Hessian H of all, one Gauss-Newton step leads to the minimum without it:

    d_c = (H - H_c)^-1 g_c.                                                                                (1)

Of G clusters the jackknife has the covariance, beside that of the prior with its information P,

    (G - 1) / G sum_c d_c d_c'  +  H^-1 P H^-1,                                                            (2)

(Tukey 1958; the CV3 of MacKinnon, Nielsen and Webb, J. Appl. Econom. 38:671, 2023). What the model cannot express,
and slip, are the same in the runs of a cluster; they count, since other clusters would have others.

The clusters that tell of a number are often few: of five commands two may turn the robot. With v_c = a'd_c for the
function a of the unknowns, and M the covariance of these v_c if the slopes of clusters have H_c for theirs, the first
part of its variance has the degrees of freedom (Satterthwaite 1946; Bell and McCaffrey, Surv. Methodol. 28:169, 2002)

    (tr M)^2 / tr M^2,    M = diag(u_c' H_c u_c) - U (H^-1 + H^-1 P H^-1) U',                             (2a)

u_c = (H - H_c)^-1 a, and H_c u_c the rows of U. The second part is exact.

Where leaving a cluster out loses a direction, no other cluster says how far an estimate scatters along it. With the
data's Hessian D = sum_c H_c in units of which D is 1, these are the directions v of

    v' H_c v > 1 - LEAST_LEFT.                                                                             (3)

Along them the covariance is the curvature's, D^-1, times the ratio of (2) to it in all other directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import grouped, roots_of
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import MANY, EstimatedCovariance
from omnibench.words import plural

FEWEST_SESSIONS = 3  # that are clusters: the 95 % interval of two would reach 13 standard errors to either side
_LEAST_LEFT = 0.1  # share of what is known of a direction that other clusters must say, too; chosen
_ROUNDING = 1e-12  # share of the largest derivative: a smaller one is rounding


def depending(slopes: Array, inputs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which functions (q,) with derivatives (q, n) depend on one of the n inputs that are marked."""
    return np.asarray((np.abs(slopes[:, inputs]) > _ROUNDING * np.abs(slopes).max()).any(axis=1))


@dataclass(frozen=True)
class Clusters:
    """Groups of runs that count as independent draws: members, indices of runs. name: command, session or run."""

    name: str
    members: tuple[tuple[int, ...], ...]
    sessions: int

    @classmethod
    def of(cls, runs: Sequence[Trajectory]) -> Clusters:
        """Sessions, where there are several; else commands, where runs repeat some; else the runs."""
        sessions = {run.session for run in runs if run.session is not None}
        commands = [run.command for run in runs if run.command is not None]
        if len(sessions) >= FEWEST_SESSIONS:
            name, keys = "session", [(run.session is not None, run.session or run.id) for run in runs]
        elif len(set(commands)) < len(commands):
            name, keys = "command", [(run.command is not None, run.command or run.id) for run in runs]
        else:
            name, keys = "run", [(True, run.id) for run in runs]
        return cls(name, tuple(grouped(keys)), max(len(sessions), 1))

    @property
    def words(self) -> str:
        """The basis of an interval: jackknife over 12 commands of one session."""
        count = len(self.members)
        basis = f"jackknife over {plural(count, self.name)}" if count > 1 else "curvature of a single run"
        return f"{basis}, of one session alone" if self.sessions == 1 else basis


def jackknife(
    information: Array, scores: Array, clusters: Clusters, prior: Array | None = None, functions: Array | None = None
) -> EstimatedCovariance:
    """Eq. (2) of some functions of the unknowns, with the degrees of freedom (q,) of each variance.

    information (Z, k, k), scores (Z, k): Hessians and slopes of the runs' parts of what was minimised. prior (k, k): P;
    None: no prior. functions (q, k): their derivatives by the unknowns; None: the unknowns themselves. Directions of
    which neither runs nor prior say anything have no variance. A single cluster has the curvature's covariance.
    """
    by_cluster = np.array([information[list(members)].sum(axis=0) for members in clusters.members])
    slopes = np.array([scores[list(members)].sum(axis=0) for members in clusters.members])
    prior = np.zeros(information.shape[1:]) if prior is None else prior
    count, data = len(by_cluster), by_cluster.sum(axis=0)
    roots = roots_of(data + prior)  # H = 1 in these coordinates
    by_cluster, slopes, own = roots.T @ by_cluster @ roots, slopes @ roots, roots.T @ prior @ roots
    wanted = roots if functions is None else functions @ roots
    whole = np.eye(roots.shape[1])
    of_data = whole - own
    if count == 1:
        return EstimatedCovariance(wanted @ wanted.T, MANY)
    alone = _carried_by_one(by_cluster, of_data)
    others = whole - alone @ alone.T
    # Along directions that one cluster alone carries, H - H_c may be singular: they are left out of Eq. (1)
    kept = [others @ (whole - of_one) @ others + alone @ alone.T for of_one in by_cluster]
    without = np.array([others @ np.linalg.solve(left, others) for left in kept])
    moved = np.einsum("cij,cj->ci", without, slopes)
    scatter = (count - 1) / count * moved.T @ moved
    if alone.shape[1]:
        seen = float(np.trace(others @ of_data))
        ratio = float(np.trace(scatter)) / seen if seen > _LEAST_LEFT else 1.0
        scatter = scatter + ratio * alone @ (alone.T @ of_data @ alone) @ alone.T
    # Eq. (2a), by the traces of M
    pulls = np.einsum("cij,qj->qci", without, wanted)
    rows = np.einsum("cij,qcj->qci", by_cluster, pulls)
    inner = whole + own
    single = np.einsum("qci,qci->qc", pulls, rows)
    shared = np.einsum("qci,ij,qcj->qc", rows, inner, rows)
    products = inner @ np.einsum("qci,qcj->qij", rows, rows)
    squares = np.square(single).sum(axis=1) - 2 * (single * shared).sum(axis=1)
    squares += np.einsum("qij,qji->q", products, products)
    expected = (single - shared).sum(axis=1)
    freedom = np.where(squares > 0, np.square(expected) / np.maximum(squares, 1e-300), count - 1)
    shares = np.diag(wanted @ scatter @ wanted.T), np.diag(wanted @ (scatter + own) @ wanted.T)
    of_scatter = np.clip(shares[0] / np.maximum(shares[1], 1e-300), 1e-9, 1.0)
    freedom = np.clip(freedom, 1.0, count - 1) / np.square(of_scatter)
    return EstimatedCovariance(wanted @ (scatter + own) @ wanted.T, np.minimum(freedom, MANY))


def _carried_by_one(by_cluster: Array, data: Array) -> Array:
    """Orthonormal directions (k, q) of which a single cluster says nearly all that is said, Eq. (3).

    by_cluster (G, k, k), data (k, k): information in units in which that of data and prior is 1. A direction that is
    left to the prior counts for none.
    """
    values, vectors = np.linalg.eigh(data)
    said = values > 1 / 2
    basis = vectors[:, said] / np.sqrt(values[said])
    carried = [np.zeros((len(data), 0))]
    for of_one in by_cluster:
        shares, directions = np.linalg.eigh(basis.T @ of_one @ basis)
        carried.append(vectors[:, said] @ directions[:, shares > 1 - _LEAST_LEFT])
    together = np.hstack(carried)
    if not together.shape[1]:
        return together
    left, strengths, _ = np.linalg.svd(together, full_matrices=False)
    return np.asarray(left[:, strengths > 1e-6])
