"""Making a term of the model: what is wrong is told in one line with its place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from effect_samples import EVERY, built_in
from sample_robots import APR_02

from omnibench.errors import DataError, OmnibenchError, UnknownNameError
from omnibench.registry import effects
from omnibench.robot.effects.effect import Effect, make_term


def test_a_term_keeps_its_parameters_in_the_given_order() -> None:
    term = make_term("wheel_eccentricity", dict.fromkeys(("b_c", "a_a", "a_b", "b_a", "a_c", "b_b"), 0.01), APR_02)
    assert list(term.values) == ["b_c", "a_a", "a_b", "b_a", "a_c", "b_b"]


def test_a_term_does_not_change_with_what_it_was_made_from() -> None:
    given = {"b": 0.001}
    term = make_term("heading_drift", given, APR_02)
    given["b"] = 0.0
    assert dict(term.values) == {"b": 0.001}


@pytest.mark.parametrize("value", [1, np.float64(1.0), np.int64(1)])
def test_any_real_number_is_a_parameter(value: float) -> None:
    found = make_term("heading_drift", {"b": value}, APR_02).values["b"]
    assert (found, type(found)) == (1.0, float)


@pytest.mark.parametrize("name", built_in(Effect))
def test_every_effect_takes_its_own_parameters(name: str) -> None:
    for robot in filter(effects.create(name).applies, EVERY.values()):
        known = effects.create(name).parameters(robot, ("x", "y"))
        given = {each.name: each.choices[-1] if each.choices else each.high for each in known}
        assert dict(make_term(name, given, robot, sessions=("x", "y")).values) == given


REFUSED: dict[str, tuple[str, Mapping[str, Any], str]] = {  # wrong types among them
    "an unknown effect": (
        "heading_drif",
        {},
        "cal.yaml: unknown effect 'heading_drif'; did you mean 'heading_drift'? known: acceleration_slip, ",
    ),
    "an unknown parameter": (
        "rotation_translation_coupling",
        {"kx": 0.1, "kz": 0.1},
        "cal.yaml: effect 'rotation_translation_coupling': unknown parameter 'kz'; did you mean 'ky'? known: kx, ky",
    ),
    "a parameter of another robot's wheel": (
        "direction_dependent_radius",
        {"k_a": 0.0, "k_b": 0.0, "k_fl": 0.0},
        "cal.yaml: effect 'direction_dependent_radius': unknown parameter 'k_fl'; ",
    ),
    "a missing parameter": (
        "floor_drift",
        {"dx": 0.1},
        "cal.yaml: effect 'floor_drift': parameter 'dy' (1) is missing; drift along y of the reference",
    ),
    "NaN": (
        "heading_drift",
        {"b": math.nan},
        "cal.yaml: effect 'heading_drift': parameter 'b' is nan, not a finite number",
    ),
    "infinity": ("heading_drift", {"b": -math.inf}, "cal.yaml: effect 'heading_drift': parameter 'b' is -inf, not"),
    "a text": ("heading_drift", {"b": "0"}, "cal.yaml: effect 'heading_drift': parameter 'b' is '0', not"),
    "a truth value": ("heading_drift", {"b": True}, "cal.yaml: effect 'heading_drift': parameter 'b' is True, not"),
    "what no robot does": (
        "heading_drift",
        {"b": 10.0},
        "cal.yaml: effect 'heading_drift': parameter 'b' is 10, not within -5 and 5",
    ),
    "a shape that cannot be": (
        "start_transient",
        {"k": 0.1, "length": 0.0},
        "cal.yaml: effect 'start_transient': parameter 'length' is 0, not within 0.001 and 10",
    ),
    "NaN for a session's radius": (
        "tyre_wear",
        {"radius_x": math.nan},
        "cal.yaml: effect 'tyre_wear': parameter 'radius_x' is nan, not a finite number",
    ),
    "a radius larger than any": (
        "tyre_wear",
        {"radius_x": 1e300},
        "cal.yaml: effect 'tyre_wear': parameter 'radius_x' is 1e+300, not within -1000 and 1000",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_told_in_one_line(case: str) -> None:
    name, parameters, words = REFUSED[case]
    with pytest.raises(OmnibenchError) as refusal:
        make_term(name, parameters, APR_02, "cal.yaml")
    assert str(refusal.value).startswith(words)
    assert isinstance(refusal.value, UnknownNameError if "unknown" in words else DataError)


def test_without_a_place_the_message_begins_with_the_effect() -> None:
    with pytest.raises(DataError, match=r"^effect 'heading_drift': parameter 'b' \(rad/s\) is missing"):
        make_term("heading_drift", {}, APR_02)


def test_tyre_wear_takes_the_radius_of_any_session_or_none() -> None:
    assert dict(make_term("tyre_wear", {"radius_2023-01-12": 0.01}, APR_02).values) == {"radius_2023-01-12": 0.01}
    assert not make_term("tyre_wear", {}, APR_02).values
