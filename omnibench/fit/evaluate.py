"""Evaluation of a calibration on a data set: Eq. (6) and the errors of the final pose."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import SPLITS, Dataset, Trajectory
from omnibench.data.domain_check import extrapolation_warning, share_outside
from omnibench.data.references import UNITS, ReferenceKind
from omnibench.data.stored import drawn_runs
from omnibench.errors import computable, require_type
from omnibench.fit.cost import NO_ERROR
from omnibench.fit.estimate import estimate, usual_problem
from omnibench.fit.intervals import BOOTSTRAPPED, FEWEST, Bootstrap, Clusters, Interval, RatioIntervals, units_of
from omnibench.fit.reference_rows import errors_by_kind, mean_errors, measured_parts
from omnibench.fit.sessions import compare_sessions
from omnibench.registry import costs
from omnibench.robot.calibration import Calibration, HeldOutVerdict
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import DIGITS
from omnibench.views import Shown
from omnibench.words import noun_for, plural

_SHOWN = 6  # runs that are named; the rest are counted (chosen: two lines of a terminal)
_PARTS = 5  # of the commands, each left out once by cross-validation
_FEWEST_CROSSED = 4  # runs, below which nothing can be left out
_MOST = 120  # runs that a verdict looks at; chosen: some seconds
# Share of what the default estimate gains on all runs: a model that gains less is not judged by it. Chosen.
_AS_GOOD = 0.9
_ALIKE = 0.1  # by which the angles that wheels turn may differ in repetitions of a command; chosen
_MEANINGS = {"better": "better than the design", "worse": "worse than the design: do not use"}
_BASES = {"held_out": "held out", "cross_validation": "cross-validated"}
_HOLD_OUT = (
    "keep runs for validation (omnibench import ... --set validation=PATTERN), or evaluate the calibration on a "
    "recording that it was not fitted to (omnibench evaluate CALIBRATION DATASET)"
)


def nothing_held_out(reason: str = "no run was held out") -> HeldOutVerdict:
    """The verdict where no run was held out."""
    sentence = f"{reason}: whether the calibration is better than the design on other runs cannot be said"
    return HeldOutVerdict(verdict="unknown", sentence=sentence, detail=f"to have it said, {_HOLD_OUT}")


def judge(
    design: Array,
    calibrated: Array,
    runs: Sequence[Trajectory],
    bootstrap: Bootstrap | None = None,
    basis: Literal["held_out", "cross_validation"] = "held_out",
) -> HeldOutVerdict:
    """The verdict by the final pose errors (Z, 3), m, m, rad, of the design values and of the calibration.

    Of runs without poses they are what ``final_errors`` says. basis: as in HeldOutVerdict.
    """
    if not runs:
        return nothing_held_out()
    bootstrap = bootstrap or Bootstrap()
    units = units_of(runs, bootstrap.unit)
    costs, before = np.linalg.norm(calibrated, axis=1), np.linalg.norm(design, axis=1)  # Eq. (6), run by run
    gain = RatioIntervals(bootstrap).improvement(costs, before, units, NO_ERROR)
    low, high = (None, None) if gain is None else (gain.low, gain.high)
    verdict: Literal["better", "worse", "undecided"] = "undecided"
    if low is not None and high is not None and not (low <= 0 <= high):
        verdict = "better" if low > 0 else "worse"
    placed, turned = measured_parts(runs)
    positions = [
        float(np.hypot(errors[:, 0], errors[:, 1])[placed].mean()) for errors in (design, calibrated) if placed.any()
    ]
    headings = [float(np.abs(errors[:, 2])[turned].mean()) for errors in (design, calibrated) if turned.any()]
    changes = []
    if positions:
        factor, unit = (1.0, "m") if max(positions) >= 1 else (1e3, "mm")
        changes.append(_change(factor * positions[0], factor * positions[1], unit))
    if headings:
        changes.append(_change(math.degrees(headings[0]), math.degrees(headings[1]), "deg"))
    names = ", ".join(run.id for run in runs[:_SHOWN])
    if len(runs) > _SHOWN:
        names += f" and {len(runs) - _SHOWN} more"
    if verdict != "undecided":
        meaning = _MEANINGS[verdict]
    elif (costs == before).all():
        meaning = "the same as the design"
    elif gain is None:
        meaning = "undecided: the design values have no error there to be improved"
    elif units.count < FEWEST:
        meaning = f"undecided: {plural(units.count, units.name)} cannot show it, hold out {FEWEST} or more"
    elif gain.known is None:
        meaning = f"undecided: the {noun_for(units.count, units.name)} differ too much for an interval"
    else:
        meaning = "undecided: chance alone can explain the difference"
    return HeldOutVerdict(
        basis=basis,
        verdict=verdict,
        runs=tuple(run.id for run in runs),
        design_position_m=positions[0] if positions else None,
        position_m=positions[1] if positions else None,
        design_heading_rad=headings[0] if headings else None,
        heading_rad=headings[1] if headings else None,
        improvement=None if gain is None else gain.value,
        low=low,
        high=high,
        unit=units.name,
        units=units.count,
        method=units.method,
        sentence=f"{_BASES[basis]} ({plural(len(runs), 'run')}): {', '.join([*changes, meaning])}",
        detail=f"{_gain_in_words(gain, units)}{noun_for(len(runs), 'run')}: {names}",
    )


def _gain_in_words(gain: Interval | None, units: Clusters) -> str:
    """The improvement of Eq. (6) with its interval and what that rests on; empty where there is none."""
    if gain is None:
        return ""
    basis, falls = units.ratio_words, gain.value >= 0
    if gain.known is not None:
        low, high = sorted(end if falls else -end for end in gain.known)
        basis = f"95 % interval {100 * low:.1f} to {100 * high:.1f} %, {basis}"
    return f"the final error, Eq. (6), {'falls' if falls else 'rises'} by {100 * abs(gain.value):.1f} % ({basis}); "


def _change(before: float, after: float, unit: str) -> str:
    """Two values with the decimals that show the smaller: ``22 mm -> 33 mm``."""
    smaller = min(value for value in (before, after, 1e3) if value > 0)
    decimals = min(3, max(0, 1 - math.floor(math.log10(smaller))))
    return f"{before:.{decimals}f} {unit} -> {after:.{decimals}f} {unit}"


class ReferenceErrors(Model):
    """Errors of a model at the references of one kind: their mean and largest magnitude, m or rad as ``unit`` says.

    in_sigmas: root mean square of the errors in standard deviations of the references; 1 for a model that is right.
    """

    kind: ReferenceKind
    references: int
    unit: Literal["m", "rad"]
    mean: float
    max: float
    in_sigmas: float


class SplitErrors(Model):
    """Cost (Eq. 6) and errors of the final pose, on one split.

    Of runs that have references in the place of poses they are means over these; None where no run has any of a
    position or length, or of an angle. references: errors at these by their kind; left out where there are none.
    outside: share of the runs' time in motions that the calibration was not fitted to; left out where it is not known.
    """

    trajectories: int = Field(exclude=True)
    cost: float
    position_mean_m: float | None
    position_max_m: float | None
    heading_mean_rad: float | None
    heading_max_rad: float | None
    references: tuple[ReferenceErrors, ...] = Field((), exclude_if=lambda references: not references)
    outside: float | None = Field(None, exclude_if=lambda outside: outside is None)


class Evaluation(Shown, Model):
    """Errors of a calibration and of the design values, by split; the split ``all`` is every trajectory.

    loss: the robust loss that the calibration was fitted with; costs and errors are without it.
    held_out: the verdict by the runs that the calibration was not fitted to; unfitted: their number by split, None
    where they are not known. sessions: a sentence for each session that differs from the others, or on those that could
    not be compared. warnings: one sentence if runs lie outside the training domain of the calibration's effects. Fields
    that are not excluded are the document of ``omnibench evaluate --json``.
    """

    dataset: str
    loss: str | None = Field(None, exclude_if=lambda loss: loss is None)
    simulated: bool = Field(exclude=True)
    trajectories: int
    splits: dict[str, SplitErrors]
    design: dict[str, SplitErrors] = Field(exclude=True)
    unfitted: dict[str, int] | None = Field(exclude=True)
    held_out: HeldOutVerdict
    sessions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@computable
def evaluate(calibration: Calibration, dataset: Dataset) -> Evaluation:
    """Errors of a calibration on every split of a data set.

    DataError: the robots' wheels differ, or the recordings lack what an effect of the calibration needs.

    >>> errors = evaluate(calibration, dataset).splits["train"]
    >>> round(errors.position_mean_m, 3), round(errors.heading_mean_rad, 3)
    (0.0, 0.0)
    """
    require_type(calibration, Calibration, "read_calibration")
    require_type(dataset, Dataset, "load_dataset")
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    groups: dict[str, tuple[Trajectory, ...]] = {split: group for split in SPLITS if (group := dataset.split(split))}
    groups["all"] = dataset.trajectories
    design = OdometryModel.of_design(dataset.robot, calibration.integration)
    fitted, designed = (ModelErrors.of(model, dataset.trajectories) for model in (calibration.model, design))
    sessions = compare_sessions(calibration.model, dataset.trajectories)
    held_out, unknown = _held_out(calibration, dataset)
    provenance, tested = calibration.provenance, {run.id for run in held_out or ()}
    runs_known = provenance is not None and (provenance.fitted is not None or provenance.dataset_hash == dataset.hash)
    training = [run for run in dataset.trajectories if runs_known and run.id not in tested]
    unfitted = None
    if held_out is not None:
        unfitted = {name: len(tested & {run.id for run in group}) for name, group in groups.items()}
    verdict = nothing_held_out(unknown) if unknown else verdict_on(calibration.model, training, held_out or ())
    warning = extrapolation_warning(calibration, dataset.trajectories)
    return Evaluation(
        dataset=dataset.name,
        loss=provenance.loss if provenance else None,
        simulated=dataset.simulated,
        trajectories=len(dataset.trajectories),
        splits={
            name: fitted.on(group).model_copy(update={"outside": share_outside(calibration, group)})
            for name, group in groups.items()
        },
        design={name: designed.on(group) for name, group in groups.items()},
        unfitted=unfitted,
        held_out=verdict,
        sessions=(*sessions.sentences, *sessions.doubts),
        warnings=() if warning is None else (warning,),
    )


def _held_out(calibration: Calibration, dataset: Dataset) -> tuple[Sequence[Trajectory] | None, str]:
    """The runs that a calibration was not fitted to, None where they are not known, and why there are none if known.

    Runs are known by their fingerprints, whatever their names and splits. Of a calibration without them, the validation
    split is held out; of another data set without one, all runs; of a data set that has the name of the one that was
    fitted but not its content or its split, nothing: it may hold the fitted runs anywhere.
    """
    runs, provenance = dataset.split("validation"), calibration.provenance
    if provenance is None:
        unknown = "which runs the calibration was fitted to is not known, and none is for validation"
        return (runs, "") if runs else (None, unknown)
    if provenance.dataset_hash == dataset.hash:
        return runs, ""
    if provenance.fitted is not None:
        # A run with the wheel samples of a fitted run is that run with a reference made anew, unless fitted runs share
        # theirs (commanded rates, or simulated ones without noise).
        fitted = set(provenance.fitted)
        wheels = {fingerprint[:DIGITS] for fingerprint in fitted}
        digits = None if len(wheels) < len(fitted) else DIGITS
        seen = fitted if digits is None else wheels
        runs = tuple(run for run in dataset.trajectories if run.fingerprint[:digits] not in seen)
        again = f"every run of {dataset.name} has the wheel samples of a run that the calibration was fitted to"
        return runs, "" if runs else again
    if provenance.dataset == dataset.name:
        changed = f"the data set {dataset.name} or its split was changed after the fit"
        return None, f"{changed}, so that which runs were fitted is not known"
    return runs or dataset.trajectories, ""


def command_names(runs: Sequence[Trajectory]) -> list[str]:
    """The command of every run; of runs without one, runs whose wheels turn alike share a name."""
    names = [run.command or "" for run in runs]
    nameless = [index for index, run in enumerate(runs) if run.command is None]
    angles = []  # that the drive signals of each run count, with their signs and without (2 M,), rad
    for run in (runs[index] for index in nameless):
        seconds = np.diff(run.times, prepend=0.0)
        angles.append(np.concatenate([run.signals.T @ seconds, np.abs(run.signals).T @ seconds]))
    driven = np.array(angles)
    firsts: list[int] = []  # index of the first run of each group that drives alike
    for row, index in enumerate(nameless):
        alike = np.abs(driven[firsts] - driven[row]).max(axis=1) <= _ALIKE * np.abs(driven[row]).max()
        first = firsts[int(alike.argmax())] if alike.any() else row
        firsts += [row] if first == row else []
        names[index] = f"like {runs[nameless[first]].id}"
    return names


def verdict_on(model: OdometryModel, training: Sequence[Trajectory], held_out: Sequence[Trajectory]) -> HeldOutVerdict:
    """The verdict on a model that was fitted to training runs, beside the design values of its robot.

    Held-out runs decide if they are of ten units or more (commands, or runs where none repeats): an error that a
    calibration halves is told from chance in 27 % of sets of three units, 67 % of five and 94 % of ten; where few
    commands count for most, in 17, 39 and 73 % (tests/studies/improvement_coverage.py, kinds usual and tails). If
    they are fewer, and all runs have more units, cross-validation by the default estimate decides, unless they say
    worse, or that estimate does not stand for the model: the model does not gain on all runs what it gains on these.
    """
    design = OdometryModel.of_design(model.robot, model.integration)
    verdict = nothing_held_out()
    if held_out:
        verdict = judge(final_errors(design, held_out), final_errors(model, held_out), held_out)
    every = looked_at([*training, *held_out])
    decided = verdict.units >= BOOTSTRAPPED or verdict.verdict == "worse"
    if decided or not training or len(every) < _FEWEST_CROSSED:
        return verdict
    names = command_names(every)
    runs = [replace(run, command=name) for run, name in zip(every, names, strict=True)]
    units = units_of(runs).count
    if units <= verdict.units or units < FEWEST:
        return verdict
    problem = usual_problem(model.robot, every, model.integration)
    whole = estimate(problem)
    # The default estimate says how the model does if the model gains at least nine tenths as much on all runs.
    models = (design, whole.model(problem), model)
    plain, usual, ours = (float(np.linalg.norm(final_errors(each, every), axis=1).mean()) for each in models)
    if not (plain - ours >= _AS_GOOD * (plain - usual) if usual < plain else ours >= plain):
        return verdict
    part_of = {name: number % _PARTS for number, name in enumerate(sorted(set(names)))}
    errors, parts = [], list[Trajectory]()
    for part in range(min(_PARTS, len(part_of))):
        out = [run for run in runs if part_of[run.command or ""] == part]
        rest = [run for run in runs if part_of[run.command or ""] != part]
        problem = usual_problem(model.robot, rest, model.integration)
        fitted = estimate(problem, near=whole).model(problem)
        errors.append((final_errors(design, out), final_errors(fitted, out)))
        parts += out
    before, after = (np.concatenate(of_parts) for of_parts in zip(*errors, strict=True))
    crossed = judge(before, after, parts, basis="cross_validation")
    beside = f"no run was held out from this fit; {verdict.detail}"
    if held_out:
        beside = f"too little was held out to decide: {verdict.sentence}"
    manner = f"{crossed.unit}s were left out by turns and predicted by estimates from the others; {beside}"
    return crossed.model_copy(update={"detail": f"{crossed.detail.rpartition('; ')[0]}; {manner}"})


def looked_at(runs: Sequence[Trajectory]) -> list[Trajectory]:
    """The runs that a verdict looks at: of very many some that chance has drawn, in memory."""
    drawn = np.sort(np.random.default_rng(0).permutation(len(runs))[:_MOST]).tolist()
    return drawn_runs([runs[index] for index in drawn])


def final_errors(model: OdometryModel, trajectories: Sequence[Trajectory]) -> Array:
    """Final pose errors (Z, 3): reported by the model minus reference, at each trajectory's last pose, m, m, rad.

    In their place, of a run that has references and no poses: the mean error of its lengths and places, 0, and that of
    its angles; 0 where it has none of these.
    """
    ends = np.concatenate(model.reported([trajectory.final_log for trajectory in trajectories]))
    errors = ends - np.array([trajectory.final_pose for trajectory in trajectories])
    for index, run in enumerate(trajectories):
        if not run.has_poses and run.references is not None:
            errors[index] = mean_errors(model, run)
    return errors


def positions_and_headings(errors: Array) -> tuple[Array, Array]:
    """Distances (Z,) in m and absolute heading errors (Z,) in rad of final pose errors (Z, 3)."""
    return np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """Errors of a model on some runs. of_final_poses: see final_errors, by the runs' ids."""

    model: OdometryModel
    of_final_poses: Mapping[str, Array]

    @classmethod
    def of(cls, model: OdometryModel, trajectories: Sequence[Trajectory]) -> ModelErrors:
        """The errors of a model on some runs."""
        ids = (run.id for run in trajectories)
        return cls(model, dict(zip(ids, final_errors(model, trajectories), strict=True)))

    def of_runs(self, trajectories: Sequence[Trajectory]) -> Array:
        """The final errors (Z, 3) of some of the runs."""
        return np.array([self.of_final_poses[run.id] for run in trajectories]).reshape(-1, 3)

    def on(self, trajectories: Sequence[Trajectory]) -> SplitErrors:
        """The errors on some of the runs."""
        errors = self.of_runs(trajectories)
        positions, headings = positions_and_headings(errors)
        placed, turned = measured_parts(trajectories)
        cost = costs.create("final_pose")  # Eq. (6)
        if any(run.references is not None for run in trajectories):
            value = cost.of_model(self.model, trajectories)
        else:
            value = float(cost.combine(errors[None], np.arange(len(errors)))[0])
        return SplitErrors(
            trajectories=len(trajectories),
            cost=value,
            position_mean_m=float(positions[placed].mean()) if placed.any() else None,
            position_max_m=float(positions[placed].max()) if placed.any() else None,
            heading_mean_rad=float(headings[turned].mean()) if turned.any() else None,
            heading_max_rad=float(headings[turned].max()) if turned.any() else None,
            references=tuple(
                ReferenceErrors(
                    kind=kind,
                    references=len(of_kind),
                    unit=UNITS[kind],
                    mean=float(np.mean(of_kind[:, 0])),
                    max=float(np.max(of_kind[:, 0])),
                    in_sigmas=float(np.sqrt(np.mean(np.square(of_kind[:, 1])))),
                )
                for kind, of_kind in errors_by_kind(self.model, trajectories).items()
            ),
        )
