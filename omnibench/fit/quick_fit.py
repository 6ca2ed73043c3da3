"""What a calibration would gain on runs that it was not fitted to, by cross-validation over commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.stored.drawn_runs import drawn_runs, in_memory
from omnibench.fit.check.missing_motions import command_names
from omnibench.fit.evaluate import final_errors
from omnibench.fit.held_out import judge
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.observations.reference_fit import ReferenceFit, Walk
from omnibench.fit.shrinkage.prior import prior_root, tolerance_of
from omnibench.fit.span import directions_kept, driven_span
from omnibench.robot.arrays import Array
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.stored.odometry_of_stored import odometry_of
from omnibench.words import plural

_PARTS = 5  # of the commands, each held out once
_FEWEST = 4  # runs, below which nothing can be held out
_SMALL = 0.1  # share of the cost: a larger gain that is not significant is left open; chosen
_ENOUGH = 10  # commands, from which on a gain would have shown if there were one; chosen
_MOST = 120  # runs that are looked at; chosen: some seconds
_SPARSE = 1.0  # s between poses, from which on headings do not lie on lines between them; chosen
_STEPS = 3  # Gauss-Newton steps by references, chosen: the design is so near that two settle


@dataclass(frozen=True)
class Gain:
    """needed: as in CheckReport. sentence: the errors before and after."""

    needed: bool | None
    sentence: str


def expected_gain(dataset: Dataset, *, clocks_agree: bool = True) -> Gain:
    """Errors at the end of runs that were held out, by the design and by a quick fit to the others.

    Of runs without poses they are those at their references. clocks_agree: False where the reference's clock is so far
    off that a gain which is not significant says nothing.
    """
    robot, every = dataset.robot, dataset.trajectories
    chosen = [in_memory(run) for run in drawn_runs(every[:: -(-len(every) // _MOST)])]
    unknown = "whether a calibration is needed cannot be told from"
    if len(chosen) < _FEWEST:
        return Gain(None, f"{unknown} {plural(len(chosen), 'run')}; {_FEWEST} are needed")
    names = command_names(chosen)
    known = {name: number for number, name in enumerate(sorted(set(names)))}
    if len(known) < 2:
        return Gain(None, f"{unknown} runs of one command; 2 are needed, of which one is held out")
    count = min(_PARTS, len(known))
    parts: list[list[Trajectory]] = [[] for _ in range(count)]
    for run, name in zip(chosen, names, strict=True):
        parts[known[name] % count].append(replace(run, command=name))
    walk = _walk(robot, [run for run in chosen if not run.has_poses])
    before, after = [], []
    for number, out in enumerate(parts):
        rest = [run for other, part in enumerate(parts) if other != number for run in part]
        before.append(final_errors(OdometryModel.of_design(robot, "arc"), out))
        after.append(final_errors(OdometryModel(robot, _fitted(robot, rest, walk), "arc"), out))
    held = [run for part in parts for run in part]
    verdict = judge(np.concatenate(before), np.concatenate(after), held)
    needed = {"better": True, "worse": False}.get(verdict.verdict)
    small = verdict.improvement is not None and abs(verdict.improvement) < _SMALL
    if verdict.verdict == "undecided" and small and verdict.units is not None and verdict.units >= _ENOUGH:
        needed = False
    if needed is None and not clocks_agree:
        return Gain(None, "whether a calibration is needed can be told once the clocks are matched")
    return Gain(needed, verdict.sentence.replace("held out", "cross-validated", 1))


def _walk(robot: Robot, runs: Sequence[Trajectory]) -> Walk:
    """How the odometry wanders beside the references of some runs."""
    design = robot.inverse_kinematic_matrix
    fit = ReferenceFit.of(runs, design, "arc")
    return Walk() if fit is None else fit.with_walk(design, prior_root(robot, tolerance_of(robot))).walk


def _fitted(robot: Robot, runs: Sequence[Trajectory], walk: Walk) -> Array:
    """The matrix (3, M) that fits the poses of runs, or, where none has any, their references."""
    posed = [run for run in runs if run.has_poses]
    if not posed:
        return _by_references(robot, runs, walk)
    odometry = odometry_of([run.reference_log for run in posed], "arc")
    reference = np.concatenate([run.poses[1:] for run in posed])
    span = driven_span(posed)
    kept = directions_kept(robot, span, "shrink")
    _, _, directions = np.linalg.svd(np.vstack([kept, np.zeros((1, len(robot.drive.names)))]))

    def fitted(headed: Sequence[Trajectory]) -> Array:
        return linear_fit(odometry, headed, reference, robot.inverse_kinematic_matrix, directions[len(kept) :])

    matrix = fitted(posed)
    sparse = float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed]))) > _SPARSE
    return fitted([_headed(run, matrix[2]) for run in posed]) if sparse else matrix


def _headed(run: Trajectory, row_3: Array) -> Trajectory:
    """The run with headings at all its samples: those that row 3 of a matrix turns by, led through the poses'."""
    edges = np.append(0.0, run.times)
    turned = np.append(0.0, np.cumsum((run.signals @ row_3) * np.diff(edges)))
    off = run.poses[:, 2] - np.interp(run.pose_times, edges, turned)
    poses = np.tile(run.poses[:1], (len(edges), 1))
    poses[1:, 2] = (turned + np.interp(edges, run.pose_times, off))[1:]
    return replace(run, pose_times=edges, poses=poses, pose_covariances=None)


def _by_references(robot: Robot, runs: Sequence[Trajectory], walk: Walk) -> Array:
    """The likeliest matrix (3, M) of the class's tolerance about the design, by the references' own uncertainty."""
    design = robot.inverse_kinematic_matrix
    root = prior_root(robot, tolerance_of(robot))
    fit = ReferenceFit.of(runs, design, "arc")
    if fit is None:
        return design
    fit = replace(fit, walk=walk)
    steps = np.zeros(root.shape[1])
    for _ in range(_STEPS):
        residuals, columns = fit.whitened(design + (root @ steps).reshape(design.shape), root)
        slopes, left = np.concatenate(columns), np.concatenate(residuals)
        steps = steps + np.linalg.solve(slopes.T @ slopes + np.eye(len(steps)), slopes.T @ left - steps)
    return design + (root @ steps).reshape(design.shape)
