"""The steps of a discovery: their order, and that what concludes fits nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from discovery_samples import simulated

from omnibench.discover import discover
from omnibench.discover.result import Discovery
from omnibench.discover.selection.model_selection import Selection
from omnibench.discover.selection.screening import Screening
from omnibench.fit.trajectory_fit import Given
from omnibench.progress import Progress
from omnibench.robot.odometry import OdometryBatch

SMALL: dict[str, Any] = {"commands": {"directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.35], "ramp": 0.3}}


def test_steps_come_in_order_confirming_only_with_an_effect_and_what_concludes_fits_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    conclude = discover.conclude

    def refuse(*_: Any) -> None:
        raise AssertionError("fitted while concluding")

    def conclude_without_fits(*args: Any) -> Discovery:
        with monkeypatch.context() as patch:
            patch.setattr(Given, "estimate", refuse)
            patch.setattr(OdometryBatch, "jacobian", refuse)
            return conclude(*args)

    monkeypatch.setattr(discover, "conclude", conclude_without_fits)
    with_effect: list[Progress] = []
    without_effect: list[Progress] = []
    assert discover.discover_effects(simulated(**SMALL), watch=with_effect.append).verdict == "named"
    discover.discover_effects(simulated((), **SMALL), watch=without_effect.append)
    confirming = "looking again, now that the noise is known better"
    stages = [
        "fitting the plain matrix",
        "looking where it fails, and at the catalogue",
        confirming,
        "looking at the motors",
        "comparing on runs that were held out",
    ]
    for events, begun in ((with_effect, stages), (without_effect, [stage for stage in stages if stage != confirming])):
        assert events == [event for stage in begun for event in (Progress(stage), Progress(stage, result=""))]


@pytest.mark.parametrize(
    ("left_share", "names"), [(1.0, ["rotation_translation_coupling"]), (0.0, [])], ids=["most", "little"]
)
def test_an_effect_that_was_given_up_is_kept_if_fitted_in_full_it_explains_most_of_what_was_left(
    left_share: float, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    select = discover.select_effects
    given_up: list[Selection] = []

    def giving_up_at_first(screening: Screening, rng: np.random.Generator) -> Selection:
        selection = select(screening, rng)
        if given_up:
            return selection
        tentative = selection.chosen
        given_up.append(replace(selection, chosen=(), stand_ins=(), tentative=tentative, left_share=left_share))
        return given_up[0]

    monkeypatch.setattr(discover, "select_effects", giving_up_at_first)
    assert [effect.name for effect in discover.discover_effects(simulated(**SMALL)).effects] == names
