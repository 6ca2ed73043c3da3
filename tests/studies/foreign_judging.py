"""Judging what is discovered in a recording by a simulator of ``foreign``."""

from __future__ import annotations

import importlib
import tempfile
import time
from pathlib import Path

from omnibench import discover_effects, load_dataset
from omnibench.config import Model
from omnibench.discover.result import Discovery
from omnibench.processes import one_thread
from omnibench.progress import Reporter

CONFIDENT = 0.95  # a name's weight from which on the verdict may be "named"


class Result(Model):
    """What came of a recording.

    right_names: effects of the catalogue that have the hidden cause. names: those that were named, with their weights.
    classes: each of these with its look-alikes. where: the covariates named, the most probable first.

    closed_chi2, closed_eq6: share of the gap to the validation session that is closed; None: no gap beyond two standard
    errors, or a failure of the workflow, whose reason is then in ``failure``.
    """

    kind: str
    seed: int
    noncentrality: float
    covariates: tuple[str, ...]
    right_names: tuple[str, ...] = ()
    verdict: str = ""
    names: tuple[tuple[str, float], ...] = ()
    classes: tuple[tuple[str, ...], ...] = ()
    where: tuple[str, ...] = ()
    closed_chi2: float | None = None
    closed_eq6: float | None = None
    seconds: float = 0.0
    failure: str = ""

    @property
    def flagged(self) -> bool:
        """Something is said to be there that no name explains."""
        return self.verdict in ("unknown", "incomplete")

    @property
    def located(self) -> bool:
        """A right covariate is among the two most probable."""
        return bool(set(self.where[:2]) & set(self.covariates))

    @property
    def named_right(self) -> bool:
        """A right name is sure, or one of a class of look-alikes that were named."""
        sure = any(weight >= CONFIDENT and name in self.right_names for name, weight in self.names)
        in_a_class = self.verdict == "class" and any(set(names) & set(self.right_names) for names in self.classes)
        return sure or in_a_class

    @property
    def misnamed(self) -> bool:
        """A wrong name is sure."""
        return any(weight >= CONFIDENT and name not in self.right_names for name, weight in self.names)


def carry_out(recording: tuple[str, int], _: Reporter) -> Result:
    """Make a recording, let the workflow discover, judge. Whatever the workflow raises is a failure."""
    kind, seed = recording
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        truth = importlib.import_module(f"foreign.{kind}").make(Path(folder), seed)
        hidden = {"seed": seed} | {key: truth[key] for key in ("kind", "covariates", "noncentrality")}
        hidden["right_names"] = truth.get("right_names", ())
        began = time.perf_counter()
        try:
            return judged(hidden, discover_effects(load_dataset(folder), seed=seed), time.perf_counter() - began)
        except Exception as error:  # the study goes on, and the table says so
            return Result(**hidden, failure=f"{type(error).__name__}: {error}")


def judged(hidden: dict[str, object], discovery: Discovery, seconds: float) -> Result:
    """The answer beside what is hidden."""
    probable = sorted(discovery.where, key=lambda each: -each.weight)
    session = next((each for each in discovery.held_out if each.data == "session"), None)
    return Result(
        **hidden,
        verdict=discovery.verdict,
        names=tuple((each.name, each.weight) for each in discovery.effects),
        classes=tuple((each.name, *each.confusable_with) for each in discovery.effects),
        where=tuple(dict.fromkeys(each.covariate for each in probable)),
        closed_chi2=session.chi2.closed if session else None,
        closed_eq6=session.eq6.closed if session else None,
        seconds=seconds,
    )
