"""The job of ``omnibench slam``: reference poses of a recording from its scans, and how good they are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from omnibench.data.dataset import Dataset
from omnibench.data.storage import check_dataset_folder, load_whole, save_dataset
from omnibench.data.true_poses import TruePath, read_true_poses, robot_of_truth
from omnibench.errors import ConfigError, DataError, Interrupted
from omnibench.files import TableFormat, refuse_existing, resolved
from omnibench.jobs.job import ResultStore
from omnibench.progress import Reporter, no_progress
from omnibench.robot.calibration import read_calibration
from omnibench.robot.model import OdometryModel
from omnibench.slam.slam_dataset import slam_paths, with_paths
from omnibench.slam.slam_options import SlamOptions
from omnibench.slam.slam_run import SlamPath
from omnibench.slam.summary import SlamAccuracy, SlamSummary, slam_accuracy, summarise

_WORKERS = 2  # processes at a time: results do not depend on their number


@dataclass(frozen=True, eq=False)
class SlamResult:
    """The data set with its new poses, their summary, and the true paths, if they are known."""

    dataset: Dataset
    summary: SlamSummary
    truth: Mapping[str, TruePath] | None

    @property
    def accuracy(self) -> SlamAccuracy | None:
        return self.summary.accuracy


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
        recorded = load_whole(self.dataset)
        truth = self._truth_of(recorded)
        model = self._model_of(recorded)
        if self.output is not None:
            check_dataset_folder(self.output)
            going_on = any(_paths_beside(self.output).glob("*.json"))  # stopped before the data set was complete
            refuse_existing(self.output, force=self.force or going_on, folders=True)
        local = _has_local_terms(model)
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

    def _model_of(self, recorded: Dataset) -> OdometryModel | None:
        if self.model is None:
            return None
        calibration = read_calibration(self.model)
        calibration.check_wheels(recorded.robot, f"the data set {recorded.name}", place=f"--model {self.model}: ")
        return calibration.model


def _has_local_terms(model: OdometryModel | None) -> bool:
    """True if terms come from plug-ins, whose classes other processes do not know and no path's key covers."""
    terms = () if model is None else model.terms
    return not all(type(term.effect).__module__.startswith("omnibench.") for term in terms)


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
