"""Judging a discovery against the truth, which it never saw."""

from __future__ import annotations

from typing import Literal

import numpy as np

from omnibench.config import Model
from omnibench.discover.result import Discovery, NamedEffect
from omnibench.fit.noise import Whitener
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

from .disturbances import VALIDATION, scaled
from .forms import FORMS
from .sets import Truth
from .signature import projected

CONFIDENT = 0.95
Outcome = Literal["right", "class", "wrong", "unknown", "none"]


class Name(Model):
    """A name that was given. right: it is that of something hidden; in_class: or of what it is confusable with."""

    name: str
    weight: float
    right: bool
    in_class: bool

    @property
    def wrong(self) -> bool:
        """It is stated with confidence, and nothing of its class is hidden."""
        return self.weight >= CONFIDENT and not self.in_class


class ParameterError(Model):
    """true: the projection of the hidden form onto the catalogue's."""

    name: str
    true: float
    value: float
    low: float
    high: float

    @property
    def covered(self) -> bool:
        return self.low <= self.true <= self.high


class Judgement(Model):
    """One data set. closed_*: share of the gap to the held-out session that is closed; None: nothing to close.

    said: by the discovery, measured against the scatter of repetitions, where that exceeds two standard errors. true:
    of the squared errors without any noise, whitened of all poses (chi2) and of the final poses as they are (eq6).
    """

    verdict: str
    names: tuple[Name, ...]
    both_right: bool
    where: tuple[str, ...]
    where_right: bool
    parameters: tuple[ParameterError, ...]
    closed_said_chi2: float | None
    closed_said_eq6: float | None
    closed_true_chi2: float | None
    closed_true_eq6: float | None
    seconds: float

    @property
    def outcome(self) -> Outcome:
        """Verdict on the first name. A name without confidence under the verdict "unknown" is no answer."""
        if not self.names or self.verdict in ("none", "unknown"):
            return "none" if self.verdict == "none" else "unknown"
        first = self.names[0]
        if first.right:
            return "class" if self.verdict == "class" else "right"
        return "class" if first.in_class else "wrong"

    @property
    def confident_wrong(self) -> bool:
        return any(name.wrong for name in self.names)

    @property
    def parameter_error(self) -> float | None:
        """Length of the error over that of the true vector of parameters."""
        if not self.parameters:
            return None
        error = np.array([each.value - each.true for each in self.parameters])
        return float(np.linalg.norm(error) / np.linalg.norm([each.true for each in self.parameters]))


def judge(discovery: Discovery, truth: Truth, seconds: float) -> Judgement:
    """Compare what is said with what is hidden. seconds: how long it took."""
    names = tuple(_name(effect, truth.names) for effect in discovery.effects)
    where = tuple(dependence.covariate for dependence in discovery.where[:2])
    found = {name.name for name in names}
    said = _said(discovery, truth)
    true = _closed_in_truth(discovery, truth) if said is not None else (None, None)
    return Judgement(
        verdict=discovery.verdict,
        names=names,
        both_right=discovery.verdict not in ("none", "unknown") and set(truth.names) <= found,
        where=where,
        where_right=bool(set(where) & set(truth.covariates)),
        parameters=_parameters(discovery, truth),
        closed_said_chi2=said[0] if said else None,
        closed_said_eq6=said[1] if said else None,
        closed_true_chi2=true[0],
        closed_true_eq6=true[1],
        seconds=seconds,
    )


def _name(effect: NamedEffect, hidden: tuple[str, ...]) -> Name:
    meant = {effect.name, *effect.confusable_with}
    right, in_class = effect.name in hidden, bool(meant & set(hidden))
    return Name(name=effect.name, weight=effect.weight, right=right, in_class=in_class)


def _said(discovery: Discovery, truth: Truth) -> tuple[float | None, float | None] | None:
    """Shares closed (chi2, Eq. 6) on the held-out session, or on repetitions where a session cannot be predicted."""
    wanted = "repetitions" if "tyre_wear" in truth.names else "session"
    for held_out in discovery.held_out:
        if held_out.data == wanted:
            return held_out.chi2.closed, held_out.eq6.closed
    return None


def _closed_in_truth(discovery: Discovery, truth: Truth) -> tuple[float | None, float | None]:
    """Shares of the squared errors on the validation runs, without noise."""
    if "tyre_wear" in truth.names:
        return None, None
    before, before_eq6 = _misfit(discovery.plain.model, truth)
    after, after_eq6 = _misfit(discovery.extended.model, truth)
    return 1 - after / before, 1 - after_eq6 / before_eq6


def _misfit(model: OdometryModel, truth: Truth) -> tuple[float, float]:
    """Sums of squares on the validation runs: of all poses, whitened; of the final poses, m and rad alike."""
    runs = [run for run in truth.clean if run.split == "validation"]
    noise = scaled(truth.disturbance, VALIDATION).known(truth.matrix)
    squares, finals = 0.0, 0.0
    for run, poses in zip(runs, model.reported([run.reference_log for run in runs]), strict=True):
        residuals: Array = run.poses[1:] - poses
        squares += float((Whitener(noise, run.pose_times[1:])(residuals) ** 2).sum())
        finals += float(residuals[-1] @ residuals[-1])
    return squares, finals


def _parameters(discovery: Discovery, truth: Truth) -> tuple[ParameterError, ...]:
    """The first name's, where it is the only hidden one."""
    if truth.kind != "single" or not discovery.effects or discovery.effects[0].name != truth.names[0]:
        return ()
    effect, hidden = discovery.effects[0], truth.hidden[0]
    shapes = hidden.values | {each.name: each.value for each in effect.parameters if each.shape}
    sight = truth.sight()
    true, _ = projected(sight, FORMS[hidden.name], shapes, truth.signature(sight))
    estimated = [each for each in effect.parameters if not each.shape and ":" not in each.name]  # but its forms
    scaled_names = [name for name in FORMS[hidden.name].plausible if not _only_later(name, truth)]
    if {each.name for each in estimated} != set(scaled_names):
        raise ValueError(f"{hidden.name} has the parameters {[each.name for each in estimated]}, not {scaled_names}")
    return tuple(
        ParameterError(name=each.name, true=true[each.name], value=each.value, low=each.low, high=each.high)
        for each in estimated
    )


def _only_later(name: str, truth: Truth) -> bool:
    """A session's radius that the training cannot know."""
    sessions = {run.session for run in truth.runs if run.split == "train"}
    return name.startswith("radius_") and name.removeprefix("radius_") not in sessions
