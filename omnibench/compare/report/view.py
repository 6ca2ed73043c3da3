"""What the report shows of one data set, gathered once: entries with their colours, errors of the design values."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

from omnibench.compare.config import CompareConfig
from omnibench.compare.plan import PlannedRun, make_plan
from omnibench.compare.result import ComparisonResult, EntryStatistics, ScoredRun
from omnibench.compare.statistics import entry_statistics
from omnibench.data.dataset import Dataset, Split
from omnibench.fit.evaluate import final_errors
from omnibench.fit.parameterisation import GeometryLimits
from omnibench.registry import calibrators
from omnibench.report.blocks import Dash, LegendItem
from omnibench.report.style import REFERENCE, SYMBOLS, THEORETICAL, colours
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

THEORETICAL_NAME = "theoretical"
SPLIT_NAMES: Mapping[Split, str] = {"train": "training", "validation": "validation"}

# The paper draws its non-parametric (genetic) result in magenta and the parametric one in brown.
_CUSTOMARY = {
    "closed_form": "#0072b2",
    "crs": "#e69f00",
    "genetic": "#aa3377",
    "isres": "#4fb0e8",
    "parametric": "#7b4b2a",
    "random_search": "#8a8f98",
}


@dataclass(frozen=True)
class Look:
    """How an entry is drawn in every plot of the report."""

    key: str
    label: str
    colour: str
    dash: Dash
    symbol: str

    @property
    def legend(self) -> LegendItem:
        return LegendItem(self.key, self.label, self.colour, self.dash)


REFERENCE_LOOK = Look("reference", "reference", REFERENCE, "solid", "circle")
THEORETICAL_LOOK = Look("theoretical", "theoretical (design values)", THEORETICAL, "dash", "circle")


@dataclass(frozen=True, eq=False)
class DatasetView:
    """One data set of the comparison.

    looks: by label, the same in the whole report. boxes: by label, what the entry searched; equal where two entries
    searched the same. theoretical: costs of the design values with their intervals. design_errors: final pose errors
    (Z, 3) in m, m, rad of the design matrix on each split that has trajectories.
    """

    name: str
    config: CompareConfig
    dataset: Dataset
    runs: tuple[ScoredRun, ...]
    statistics: tuple[EntryStatistics, ...]
    looks: Mapping[str, Look]
    boxes: Mapping[str, Hashable]
    theoretical: EntryStatistics | None
    design_errors: Mapping[Split, Array]

    @property
    def scored(self) -> Split:
        """The split that the verdict is about: validation where there is one."""
        return "validation" if "validation" in self.design_errors else "train"

    @property
    def best(self) -> EntryStatistics | None:
        """The best entry, unless nothing gave an answer."""
        return next((entry for entry in self.statistics if entry.is_best and entry.typical is not None), None)

    @property
    def level(self) -> list[EntryStatistics]:
        """Entries that are practically equal to the best, itself among them."""
        return [entry for entry in self.statistics if entry.practically_equal or entry.is_best]

    @property
    def calibrated(self) -> list[tuple[EntryStatistics, ScoredRun]]:
        """Entries with an answer, and their typical run; without the design values."""
        return [
            (entry, entry.typical)
            for entry in self.statistics
            if entry.typical is not None and entry.calibrator != THEORETICAL_NAME
        ]

    @property
    def reference_entry(self) -> tuple[EntryStatistics, ScoredRun] | None:
        """The entry that matrices are compared with: the exact optimum, else the best calibration."""
        exact = [pair for pair in self.calibrated if calibrators.entry(pair[0].calibrator).cls.exact]
        best = [pair for pair in self.calibrated if pair[0].is_best]
        return next(iter(exact + best + self.calibrated), None)

    def theoretical_cost(self, split: Split) -> float | None:
        """The cost of the design values, which every run's record holds."""
        for run in self.runs:
            record = run.record
            return record.theoretical_train_cost if split == "train" else record.theoretical_validation_cost
        return None

    def errors(self, run: ScoredRun, split: Split) -> Array | None:
        """Final pose errors (Z, 3) of a run's answer, m, m, rad."""
        return run.train_errors if split == "train" else run.validation_errors

    def model(self, matrix: Array) -> OdometryModel:
        """The odometry that the comparison used, with another matrix."""
        return OdometryModel(self.dataset.robot, matrix, self.config.integration)

    @property
    def design_matrix(self) -> Array:
        """The design matrix (3, N)."""
        return self.dataset.robot.inverse_kinematic_matrix


def is_bounded(calibrator: str) -> bool:
    """Whether a calibrator keeps to the box; not so a matrix that is given or kept as it is."""
    classes = {entry.name: entry.cls for entry in calibrators.entries()}
    return bool(getattr(classes.get(calibrator), "bounded", True))


def views(result: ComparisonResult) -> list[DatasetView]:
    """The data sets of a comparison, in the config's order."""
    looks = _looks(result)
    plan = make_plan(result.config, result.datasets)
    return [_view(result, name, looks, plan) for name in result.datasets]


def _view(result: ComparisonResult, name: str, looks: Mapping[str, Look], plan: Sequence[PlannedRun]) -> DatasetView:
    dataset = result.datasets[name]
    splits: tuple[Split, ...] = ("train", "validation")
    present = [split for split in splits if dataset.split(split)]
    design = OdometryModel.of_design(dataset.robot, result.config.integration)
    runs = tuple(run for run in result.runs if run.record.dataset == name)
    return DatasetView(
        name=name,
        config=result.config,
        dataset=dataset,
        runs=runs,
        statistics=tuple(entry for entry in result.statistics if entry.dataset == name),
        looks=looks,
        boxes={run.label: _searched(run) for run in plan if run.dataset_name == name},
        theoretical=_theoretical(result, runs[0]) if runs else None,
        design_errors={split: final_errors(design, dataset.split(split)) for split in present},
    )


def _searched(run: PlannedRun) -> Hashable:
    """The content of a run's box: a name like ``custom`` may stand for several."""
    if run.parameterisation == "geometry":
        return run.parameterisation, run.entry.limits or GeometryLimits()
    return run.parameterisation, run.entry.box or run.config.box


def _theoretical(result: ComparisonResult, run: ScoredRun) -> EntryStatistics:
    """Statistics of the design values, which every run holds the costs of, as if they were its answer."""
    record = run.record.model_copy(
        update={
            "label": THEORETICAL_NAME,
            "train_cost": run.record.theoretical_train_cost,
            "validation_cost": run.record.theoretical_validation_cost,
        }
    )
    design = replace(
        run,
        record=record,
        train_costs=run.theoretical_train_costs,
        validation_costs=run.theoretical_validation_costs,
    )
    (statistics,) = entry_statistics([design], result.config.bootstrap)
    return statistics


def _looks(result: ComparisonResult) -> dict[str, Look]:
    names = {entry.label: entry.calibrator for entry in result.statistics}
    names |= {run.record.label: run.record.calibrator for run in result.runs}
    searches = {label: name for label, name in names.items() if name != THEORETICAL_NAME}
    styles = colours({label: _CUSTOMARY.get(name) for label, name in searches.items()})
    looks = {
        label: Look(f"entry-{index}", label, colour, dash, SYMBOLS[index % len(SYMBOLS)])
        for index, (label, (colour, dash)) in enumerate(styles.items())
    }
    return {label: looks.get(label, THEORETICAL_LOOK) for label in names}
