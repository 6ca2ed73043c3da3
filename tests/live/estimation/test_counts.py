"""What is counted of a robot's inputs, in words."""

from __future__ import annotations

from dataclasses import fields

from omnibench.live.estimation.counts import Counts, anomalies_in_words


def test_every_anomaly_is_told_in_words_that_agree_with_its_number() -> None:
    every = Counts(**{field.name: 2 for field in fields(Counts)}).anomalies()
    words = anomalies_in_words(every)
    assert words.count("2 ") == len(every)
    assert "_" not in words.replace("max_gap", "").replace("max_rate", "")
    assert anomalies_in_words({"missing": 1, "pose_invalid": 3}) == "1 wheel sample missing, 3 poses invalid"
