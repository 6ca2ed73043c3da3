"""``discovery.json``: how the records of a result are written in it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from discovery_samples import incomplete
from pydantic_core import to_json
from report_page import NUMBER
from syrupy.assertion import SnapshotAssertion

from omnibench.discover.result import EstimatedParameter, NotLookedFor, discovery_document


def test_a_discovery_is_written_with_names_and_paths_in_the_place_of_data_and_models(
    snapshot: SnapshotAssertion,
) -> None:
    effect = incomplete().effects[0]
    shape = EstimatedParameter("length", 0.05, "m", 0.05, 0.05, shape=True)  # has no interval
    found = replace(
        incomplete(),
        dataset_hash="of the whole recording",  # not of the runs without outliers
        effects=(replace(effect, parameters=(*effect.parameters, shape)),),
        not_looked_for=(NotLookedFor("tyre_wear", "all runs are of one session"),),
    )
    written = json.loads(to_json(discovery_document(found, Path("/results"))))
    assert written["runs"] == len(found.trajectories)
    assert written["noise"]["components"] == found.noise.noise.model_dump()
    session, held_out = written["held_out"]["session"], found.held_out[-1]
    assert session["position_m"] == dict(zip(("before", "after"), held_out.position_m, strict=True))
    assert NUMBER.sub("#", json.dumps(written, indent=1)) == snapshot
