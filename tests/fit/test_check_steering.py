"""The check of recordings of a robot that steers."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wheeled_samples import TRICYCLE, driven

from omnibench import check, save_dataset
from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog


def test_two_units_that_are_wrong_at_once_are_both_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    sound = driven(TRICYCLE, 8, 200)
    runs = [
        replace(run, steering=np.degrees(run.steering), poses=run.poses * (1, 1, 180 / np.pi))
        for run in sound.trajectories
        if run.steering is not None
    ]
    save_dataset(make_dataset("trike", TRICYCLE, sound.sample_period, runs), "log")
    assert {"steering_unit=deg", "heading_unit=deg"} <= set(shlex.split(check("log").command))


def test_a_steering_that_is_held_forward_and_backward_is_not_frozen() -> None:
    """Its turns differ in sign by the way the wheels roll, and by nothing else."""
    times, stamps = 0.05 * np.arange(1, 201), np.arange(0.0, 10.0, 0.1)
    angles, runs = np.full((200, 1), 0.4), []
    for name, rate in (("f1", 6.0), ("b1", -6.0), ("f2", 5.0), ("b2", -5.0)):
        rates = np.full((200, 1), rate)
        log = WheelLog(times, rates, np.zeros(3), stamps, steering=angles, drive=TRICYCLE.drive)
        (poses,) = OdometryModel.of_design(TRICYCLE, "arc").poses([log])
        scattered = poses + np.random.default_rng(len(runs)).normal(0, 0.001, poses.shape)
        runs.append(Trajectory(name, "train", times, rates, stamps, scattered, steering=angles))
    found = check(make_dataset("held", TRICYCLE, 0.05, runs)).findings
    assert "steering_frozen" not in {finding.kind for finding in found}


def test_a_steering_that_counts_nothing_on_wide_circles_and_straight_lines_is_frozen() -> None:
    times, stamps = 0.05 * np.arange(1, 401), np.arange(0.0, 20.0, 0.1)
    runs = []
    for name, angle in (("circle", 0.15), ("line", 0.0)):
        rates = np.full((400, 1), 6.0)
        log = WheelLog(times, rates, np.zeros(3), stamps, steering=np.full((400, 1), angle), drive=TRICYCLE.drive)
        (poses,) = OdometryModel.of_design(TRICYCLE, "arc").poses([log])
        scattered = poses + np.random.default_rng(len(runs)).normal(0, 0.003, poses.shape)
        runs.append(Trajectory(name, "train", times, rates, stamps, scattered, steering=np.zeros((400, 1))))
    found = check(make_dataset("dead", TRICYCLE, 0.05, runs)).findings
    assert "steering_frozen" in {finding.kind for finding in found}
