"""``discovery.json``: how the records of a result are written in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from discovery_samples import named
from pydantic_core import to_jsonable_python

from omnibench.discover.result import (
    Absorbed,
    Candidate,
    EstimatedParameter,
    Gap,
    HeldOut,
    NamedEffect,
    NotLookedFor,
    discovery_document,
)

GAP = Gap("eq6", 5.0, 2.0, 1.0, 0.75, 0.1)


def test_parameters_stand_under_their_names_and_shapes_without_an_interval() -> None:
    parameters = (
        EstimatedParameter("k", 0.2, "1", 0.1, 0.3),
        EstimatedParameter("length", 0.05, "m", 0.05, 0.05, shape=True),
    )
    effect = NamedEffect("start_transient", "body", 0.9, parameters, ("floor_drift",), "", "", 40.0, 1, "", 0.99)
    written = to_jsonable_python(effect)
    assert written["parameters"] == {
        "k": {"value": 0.2, "unit": "1", "low": 0.1, "high": 0.3, "shape": False},
        "length": {"value": 0.05, "unit": "m", "low": None, "high": None, "shape": True},
    }
    assert written["gain"] == 40.0
    assert "class_weight" not in written


def test_a_candidate_says_what_it_would_gain() -> None:
    written = to_jsonable_python(Candidate("floor_drift", 12.5, 2, 0.01))
    assert written == {"name": "floor_drift", "gain": 12.5, "degrees_of_freedom": 2, "weight": 0.01}


def test_errors_on_held_out_runs_stand_as_before_and_after() -> None:
    written = to_jsonable_python(HeldOut("session", 12, GAP, GAP, (0.05, 0.02), (0.01, 0.004)))
    assert written["position_m"] == {"before": 0.05, "after": 0.02}
    assert written["heading_rad"] == {"before": 0.01, "after": 0.004}
    assert written["eq6"]["closed"] == 0.75


def test_a_discovery_is_written_with_names_and_paths_in_the_place_of_data_and_models() -> None:
    found = replace(
        named(),
        dataset_hash="of the whole recording",  # not of the runs without outliers
        held_out=(HeldOut("session", 12, GAP, GAP, (0.05, 0.02), (0.01, 0.004)),),
        absorbed=("lidar_yaw",),
        measurements=(Absorbed("lidar_yaw", "reference", "turn on the spot"),),
        not_looked_for=(NotLookedFor("tyre_wear", "all runs are of one session"),),
    )
    written = discovery_document(found, Path("/results"))
    assert written["model"] == "/results/model.yaml"
    assert written["plain_model"] == "/results/plain.yaml"
    assert (written["dataset"], written["dataset_hash"]) == (found.dataset.name, "of the whole recording")
    assert list(written["held_out"]) == ["session"]
    assert written["runs"] == len(found.trajectories)
    assert written["noise"]["components"] == found.noise.noise.model_dump()
    assert written["absorbed"] == ["lidar_yaw"]
    assert written["not_looked_for"] == [{"name": "tyre_wear", "reason": "all runs are of one session"}]
    assert not {"before", "after", "whitened_before", "whitened_after", "trajectories"} & set(written)
