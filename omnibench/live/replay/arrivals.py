"""The config of a replay, and its schedule: messages arrive delayed, jittered, not at all or twice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from omnibench.config import Model, NonNegative, Positive
from omnibench.data.dataset import Split
from omnibench.live.replay.concatenated_drive import LONGEST_PAUSE, ConcatenatedDrive
from omnibench.robot.kinematics import Array

WHEELS, SLAM = 0, 1  # indices in TOPICS_PLAYED
TOPICS_PLAYED: Final = ("joint_states", "slam_pose")

_SAME_TIME = 1e-6  # s; times that differ by less are equal
_LATEST_ORIGIN = (2**31 - 10**8) * 10**9  # ns; ROS 2's stamps end at 2^31 s

Share = Annotated[float, Field(ge=0, le=1)]
Delay = Annotated[float, Field(ge=0, le=3600)]  # s; an hour is longer than any network's; chosen


class Channel(Model):
    """The network from sensor to node: delays and losses of messages, in s of the recording at any speed."""

    delay: Delay = Field(0.0, description="of each message, s")
    jitter: Delay = Field(0.0, description="additional delay of each message, half-normal: |N(0, jitter)|, s")
    drop: Share = Field(0.0, description="share of the messages that never arrive")
    duplicate: Share = Field(0.0, description="share of the messages that arrive twice, each time with its own jitter")


class WheelChannel(Channel):
    """The network that wheel samples take."""

    use: Literal["positions", "velocities", "both"] = Field("both", description="content of the messages")


class PoseDeviation(Model):
    """Standard deviations of a pose."""

    position: Positive = Field(0.02, description="standard deviation of x and of y, m")
    heading: Positive = Field(0.02, description="standard deviation, rad")


class SlamChannel(Channel):
    """The network that SLAM poses take."""

    delay: Delay = Field(0.2, description="of each message, s")
    jitter: Delay = Field(0.02, description="additional delay of each message, half-normal: |N(0, jitter)|, s")
    period: Delay = Field(0.25, description="least time between two poses, s")
    covariance: PoseDeviation | None = Field(
        None, description="for poses without covariance in the data set; default: the noise model's, else 0.02 m, rad"
    )


def _speed(value: Any) -> Any:
    return math.inf if value == "max" else value


class ReplayConfig(Model):
    """Settings of a replay of a recording."""

    speed: Annotated[float, BeforeValidator(_speed, json_schema_input_type=float | Literal["max"])] = Field(
        1.0,
        ge=1e-3,
        description="1: real time; 10: ten times as fast; max: as fast as possible without losing messages",
    )
    pause: float = Field(1.0, ge=0, le=LONGEST_PAUSE, description="standstill between two runs, s")
    split: Split | None = Field(None, description="replay only the runs of this split")
    seed: int = Field(0, ge=0, description="random seed of jitter, drops and duplicates")
    wheels: WheelChannel = WheelChannel()
    slam: SlamChannel = SlamChannel()
    stamp_origin: int | None = Field(
        None,
        gt=0,
        le=_LATEST_ORIGIN,
        description="stamp of the recording's start, ns; default: the replay's start",
    )
    wait: NonNegative = Field(10.0, description="longest wait for a subscriber of the wheel samples, s; 0: do not wait")


@dataclass(frozen=True, eq=False)
class Schedule:
    """All messages by time of arrival: arrivals (E,) s; topics (E,) in TOPICS_PLAYED; rows (E,) in the drive."""

    arrivals: Array
    topics: NDArray[np.int8]
    rows: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.arrivals)


def make_schedule(drive: ConcatenatedDrive, config: ReplayConfig) -> Schedule:
    """The arrivals of a drive's messages. They depend on the seed only; each topic has its own random numbers."""
    wheel_seed, slam_seed = np.random.SeedSequence(config.seed).spawn(2)
    samples, sampled = _arrivals(drive.wheel_times, config.wheels, np.random.default_rng(wheel_seed))
    kept = _thinned(drive.slam_times, config.slam.period)
    poses, posed = _arrivals(drive.slam_times[kept], config.slam, np.random.default_rng(slam_seed))
    arrivals = np.concatenate([sampled, posed])
    topics = np.repeat(np.array([WHEELS, SLAM], dtype=np.int8), [len(samples), len(poses)])
    rows = np.concatenate([samples, kept[poses]])
    order = np.argsort(arrivals, kind="stable")
    return Schedule(arrivals[order], topics[order], rows[order])


def _arrivals(times: Array, channel: Channel, rng: np.random.Generator) -> tuple[NDArray[np.intp], Array]:
    """Indices (E,) of the messages that arrive, some of them twice, and their times of arrival (E,)."""
    chance, jitter = rng.random((2, len(times))), np.abs(rng.standard_normal((2, len(times))))
    arrives = chance[0] >= channel.drop
    twice = arrives & (chance[1] < channel.duplicate)
    late = times + channel.delay + channel.jitter * jitter
    indices = np.concatenate([np.flatnonzero(arrives), np.flatnonzero(twice)])
    when = np.concatenate([late[0][arrives], late[1][twice]])
    order = np.lexsort((indices, when))
    return indices[order], when[order]


def _thinned(times: Array, period: float) -> NDArray[np.intp]:
    """Indices of times that are at least ``period`` s apart, beginning with the first."""
    kept, index = [], 0
    while index < len(times):
        kept.append(index)
        index = max(index + 1, int(np.searchsorted(times, times[index] + period - _SAME_TIME)))
    return np.array(kept, dtype=np.intp)
