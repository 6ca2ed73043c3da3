"""The job of ``omnibench slam``: reference poses of a recording from its scans, their accuracy and summary."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.storage import check_dataset_folder, load_dataset, save_dataset
from omnibench.data.true_poses import TruePath, read_true_poses, robot_of_truth
from omnibench.errors import ConfigError, DataError, Interrupted
from omnibench.files import TableFormat, refuse_existing, resolved
from omnibench.jobs.job import ResultStore
from omnibench.progress import Reporter, no_progress
from omnibench.robot.calibration import read_calibration
from omnibench.robot.kinematics import Array, interpolated, moved_to, rotated
from omnibench.slam.slam_dataset import SlamPath, slam_paths, with_paths
from omnibench.slam.slam_options import SlamOptions

# Share of the largest variance below which a covariance counts as singular: rounding of its eigenvalues.
_SINGULAR = 1e-14


class ErrorSummary(Model):
    """Errors of poses. The bias is the mean error along the robot's axes, the systematic part of the error."""

    poses: int
    position_mean_m: float
    position_p95_m: float
    position_max_m: float
    heading_mean_rad: float
    heading_p95_rad: float
    heading_max_rad: float
    bias_forward_m: float
    bias_left_m: float
    bias_heading_rad: float
    nees_mean: float | None = Field(
        description="mean of error' covariance^-1 error; 3 for honest covariances; singular ones are left out"
    )


class SlamAccuracy(Model):
    """Errors of the last pose of every run, and of all poses but the start poses."""

    runs: int
    distance_m: float = Field(description="driven in all")
    final: ErrorSummary
    every: ErrorSummary
    drift_position: float = Field(description="growth of the position's error, m per m driven")
    drift_heading: float = Field(description="growth of the heading's error, rad per m driven")


def slam_accuracy(poses: Dataset, truth: Mapping[str, TruePath]) -> SlamAccuracy:
    """Errors of a data set's reference poses against the true paths.

    DataError in one line: a run is not in the truth, or has no pose after its start.
    """
    runs = []
    for trajectory in poses.trajectories:
        if trajectory.id not in truth:
            raise DataError(
                f"data set {poses.name}: trajectory {trajectory.id} is not in the truth; name that of this data set"
            )
        if len(trajectory.pose_times) < 2:
            raise DataError(f"data set {poses.name}: trajectory {trajectory.id} has no pose after its start")
        runs.append(run_errors(trajectory, truth[trajectory.id]))
    driven = np.concatenate([run.driven for run in runs])
    return SlamAccuracy(
        runs=len(runs),
        distance_m=sum(float(run.driven[-1]) for run in runs),
        final=_summary([run.of(slice(-1, None)) for run in runs]),
        every=_summary(runs),
        drift_position=_growth(driven, np.concatenate([run.position for run in runs])),
        drift_heading=_growth(driven, np.concatenate([run.heading for run in runs])),
    )


@dataclass(frozen=True, eq=False)
class RunErrors:
    """Errors of a run's reference poses after the first.

    times (K,): times of the poses, s. driven (K,): true distance driven until then, m. in_robot (K, 3): errors along
    the robot's axes, m, m, rad. nees (K,): error' covariance^-1 error, NaN where the covariance is singular; None
    without covariances.
    """

    times: Array
    driven: Array
    in_robot: Array
    nees: Array | None

    @property
    def position(self) -> Array:
        """Magnitudes (K,) of the position's errors, m."""
        return np.hypot(self.in_robot[:, 0], self.in_robot[:, 1])

    @property
    def heading(self) -> Array:
        """Magnitudes (K,) of the heading's errors, rad."""
        return np.abs(self.in_robot[:, 2])

    def of(self, poses: slice | NDArray[np.bool_]) -> RunErrors:
        """The errors of some of the poses."""
        nees = None if self.nees is None else self.nees[poses]
        return RunErrors(self.times[poses], self.driven[poses], self.in_robot[poses], nees)


def run_errors(trajectory: Trajectory, truth: TruePath) -> RunErrors:
    """Errors of a run's reference poses after the first, at their stamps; the true path begins at the run's start."""
    times = trajectory.pose_times[1:]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth.poses[:, :2], axis=0).T))])
    true = TruePath(truth.times, moved_to(trajectory.start, truth.poses)).at(times)
    errors = trajectory.poses[1:] - true
    covariances = trajectory.pose_covariances
    nees = None if covariances is None else _nees(errors, covariances[1:])
    in_robot = np.column_stack([rotated(errors, -true[:, 2]), errors[:, 2]])
    return RunErrors(times, np.interp(times, truth.times, way), in_robot, nees)


def _nees(errors: Array, covariances: Array) -> Array:
    """Normalised squared errors e' C^-1 e (K,); NaN where the covariance C is singular."""
    values, directions = np.linalg.eigh(covariances)
    regular = values[:, 0] > _SINGULAR * values[:, -1]
    along = np.einsum("kij,ki->kj", directions[regular], errors[regular])
    nees = np.full(len(errors), np.nan)
    nees[regular] = (along**2 / values[regular]).sum(axis=1)
    return nees


def _summary(runs: list[RunErrors]) -> ErrorSummary:
    errors = np.concatenate([run.in_robot for run in runs])
    nees = np.concatenate([run.nees for run in runs if run.nees is not None] or [np.zeros(0)])
    nees = nees[np.isfinite(nees)]
    forward, left, turned = errors.mean(axis=0).tolist()
    bias = {"bias_forward_m": forward, "bias_left_m": left, "bias_heading_rad": turned}
    return ErrorSummary(**_spread(errors), **bias, nees_mean=float(nees.mean()) if len(nees) else None)


def _spread(errors: Array) -> dict[str, float]:
    """Number of errors (K, 3), and mean, 95 % quantile and maximum of their positions and headings."""
    sizes = {"position_{}_m": np.hypot(errors[:, 0], errors[:, 1]), "heading_{}_rad": np.abs(errors[:, 2])}
    spread: dict[str, float] = {"poses": len(errors)}
    for name, size in sizes.items():
        spread |= {name.format("mean"): float(size.mean()), name.format("p95"): float(np.quantile(size, 0.95))}
        spread[name.format("max")] = float(size.max())
    return spread


def _growth(driven: Array, sizes: Array) -> float:
    """Slope k of error^2 = noise^2 + (k distance)^2 by least squares; 0 where errors do not grow."""
    ways = driven**2 - (driven**2).mean()
    spread = float(ways @ ways)
    return float(np.sqrt(max(0.0, ways @ sizes**2 / spread))) if spread > 0 else 0.0


_SAME_TIME = 1e-6  # s: rounding of stamps; poses that are nearer in time are of the same time


class Distances(Model):
    """Distances between two sets of poses of the same runs and times, without the start poses."""

    poses: int
    position_mean_m: float
    position_p95_m: float
    heading_mean_rad: float
    heading_p95_rad: float


class SlamSummary(Model):
    """SLAM of a data set. Deviations are the standard deviations that SLAM states for the runs' last poses."""

    dataset: str
    simulated: bool
    runs: int
    scans: int
    matched_mean: float = Field(description="share of a scan's points that lie on the map, mean over all scans")
    matched_min: float = Field(description="matched share of the worst scan")
    position_deviation_mean_m: float = Field(description="along the least certain direction; mean over runs")
    position_deviation_max_m: float = Field(description="along the least certain direction; worst run")
    heading_deviation_mean_rad: float
    heading_deviation_max_rad: float
    recorded: Distances | None = Field(
        description="distance from the poses that the data set held before; None: not comparable"
    )
    accuracy: SlamAccuracy | None = Field(description="against the truth of a simulation, if that is known")
    warnings: tuple[str, ...]


def summarise(
    before: Dataset, after: Dataset, paths: Sequence[SlamPath], accuracy: SlamAccuracy | None = None
) -> SlamSummary:
    """Summary of SLAM. before: the data set with its recorded poses. after: with the poses of ``paths``."""
    matched = np.concatenate([path.matched for path in paths])
    last = np.array([path.covariances[-1] for path in paths])
    position = np.sqrt(np.linalg.eigvalsh(last[:, :2, :2])[:, -1])
    heading = np.sqrt(last[:, 2, 2])
    return SlamSummary(
        dataset=after.name,
        simulated=after.simulated,
        runs=len(paths),
        scans=sum(len(before.scans.times(run.id)) for run in before.trajectories) if before.scans else 0,
        matched_mean=float(matched.mean()),
        matched_min=float(matched.min()),
        position_deviation_mean_m=float(position.mean()),
        position_deviation_max_m=float(position.max()),
        heading_deviation_mean_rad=float(heading.mean()),
        heading_deviation_max_rad=float(heading.max()),
        recorded=distances(before, after),
        accuracy=accuracy,
        warnings=after.warnings,
    )


def distances(one: Dataset, other: Dataset) -> Distances | None:
    """Distances between the reference poses of two data sets of the same runs; None when they have no common times.

    Compared at the stamps of the data set with fewer poses; the other's poses are interpolated by straight lines.
    """
    pairs = zip(one.trajectories, other.trajectories, strict=True)
    errors = np.concatenate([_apart(mine, theirs) for mine, theirs in pairs])
    if not len(errors):
        return None
    return Distances(**{name: value for name, value in _spread(errors).items() if name in Distances.model_fields})


def _apart(one: Trajectory, other: Trajectory) -> Array:
    """Differences (K, 3) at the common times after the start; only whole turns at the start are taken away."""
    sparse, dense = sorted((one, other), key=lambda run: len(run.pose_times))
    times, within = sparse.pose_times, dense.pose_times[[0, -1]] + [-_SAME_TIME, _SAME_TIME]
    common = (times > _SAME_TIME) & (times >= within[0]) & (times <= within[1])
    turns = np.round((sparse.poses[0, 2] - dense.poses[0, 2]) / (2 * np.pi))
    there = interpolated(times[common], dense.pose_times, dense.poses)
    return sparse.poses[common] - there - [0.0, 0.0, 2 * np.pi * turns]


_WORKERS = 2  # processes at a time: results do not depend on their number


@dataclass(frozen=True, eq=False)
class SlamResult:
    """The data set with its new poses, their summary, and the true paths, if they are known."""

    dataset: Dataset
    summary: SlamSummary
    truth: Mapping[str, TruePath] | None


@dataclass(frozen=True)
class SlamRequest:
    """Arguments of ``omnibench slam``.

    dataset: folder of the recording. output: folder to write with the new poses; None: none. model: a calibration file,
    whose odometry the search starts from; None: the design values. truth: the folder that ``simulate --truth`` wrote.
    force: replace the data set that is in ``output``. ConfigError in one line: the recording would be written over.
    """

    dataset: Path
    output: Path | None = None
    options: SlamOptions = field(default_factory=SlamOptions)
    model: Path | None = None
    truth: Path | None = None
    force: bool = False

    def __post_init__(self) -> None:
        if self.output is not None and resolved(self.output) == resolved(self.dataset):
            raise ConfigError(f"-o {self.output}: is the recording itself; name another folder")
        if self.model is not None and self.options.start != "odometry":
            raise ConfigError(f"--model {self.model}: is for --start odometry; leave one of the two out")

    def run(self, watch: Reporter = no_progress, table_format: TableFormat = "parquet") -> SlamResult:
        """Find the poses and write the data set. DataError in one line, before the work where that can be.

        Until the data set is written, the paths found so far are kept in a folder beside it, with which the command
        goes on when it is run again. Interrupted: Ctrl-C; the message names that folder, as a note of any error does.
        """
        recorded = load_dataset(self.dataset)
        truth, model = self._truth_of(recorded), None
        if self.model is not None:
            calibration = read_calibration(self.model)
            calibration.check_wheels(recorded.robot, f"the data set {recorded.name}", place=f"--model {self.model}: ")
            model = calibration.model
        if self.output is not None:
            check_dataset_folder(self.output)
            going_on = any(_paths_beside(self.output).glob("*.json"))  # stopped before the data set was complete
            refuse_existing(self.output, force=self.force or going_on, folders=True)
        # Terms of plug-ins, whose classes other processes do not know and no path's key covers.
        terms = () if model is None else model.terms
        local = not all(type(term.effect).__module__.startswith("omnibench.") for term in terms)
        folder = None if local or self.output is None else _paths_beside(self.output)
        with _kept(folder):
            workers = 1 if local else _WORKERS
            paths = slam_paths(recorded, self.options, model=model, workers=workers, folder=folder, watch=watch)
            found = with_paths(recorded, paths)
            if self.output is not None:
                save_dataset(found, self.output, table_format, overwrite=self.force)
        accuracy = None if truth is None else slam_accuracy(found, truth)
        return SlamResult(found, summarise(recorded, found, paths, accuracy), truth)

    def _truth_of(self, recorded: Dataset) -> Mapping[str, TruePath] | None:
        if self.truth is None:
            return None
        truth = read_true_poses(self.truth)
        if robot_of_truth(self.truth) not in (None, recorded.robot):
            raise DataError(f"--truth {self.truth}: it is another robot's; name the truth of this data set")
        for trajectory in recorded.trajectories:
            if trajectory.id not in truth:
                raise DataError(
                    f"--truth {self.truth}: trajectory {trajectory.id} is not in it; name the truth of this data set"
                )
        return truth


def _paths_beside(output: Path) -> Path:
    named = output if output.name not in ("", "..") else resolved(output)
    return named.with_name(f"{named.name}.slam-paths")


@contextmanager
def _kept(folder: Path | None) -> Iterator[None]:
    """Remove the folder of paths when the block ends well; else the error says where they are.

    Interrupted: after Ctrl-C. Other errors get a note.
    """
    if folder is None:
        yield
        return
    try:
        yield
    except (KeyboardInterrupt, Exception) as error:
        if not any(folder.glob("*.json")):
            raise
        kept = f"the paths found so far are kept in {folder}"
        if isinstance(error, KeyboardInterrupt):
            raise Interrupted(f"interrupted; {kept}: run the command again") from None
        error.add_note(kept)
        raise
    ResultStore(folder, SlamPath).remove()
