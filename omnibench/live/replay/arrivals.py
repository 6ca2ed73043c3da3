"""How a recording is to be played, and when each of its messages arrives: late, jittered, dropped or twice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from omnibench.config import Model
from omnibench.data.dataset import Split
from omnibench.live.replay.concatenated_drive import LONGEST_PAUSE, ConcatenatedDrive
from omnibench.robot.calibration import NonNegative
from omnibench.robot.kinematics import Array

WHEELS, SLAM = 0, 1
TOPICS_PLAYED: Final = ("joint_states", "slam_pose")

_SAME_TIME = 1e-6  # s
_LATEST_ORIGIN = (2**31 - 10**8) * 10**9  # ns; ROS 2's stamps end at 2^31 s

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Channel(Model):
    """What happens to messages between being taken and arriving; s are of the recording, whatever the speed."""

    delay: NonNegative = Field(0.0, description="of every message, s")
    jitter: NonNegative = Field(0.0, description="more delay, half-normal: |N(0, jitter)| for each message, s")
    drop: Share = Field(0.0, description="share of the messages that never arrive")
    duplicate: Share = Field(0.0, description="share of the messages that arrive twice, with a jitter for each")


class WheelChannel(Channel):
    """The wheel samples."""

    use: Literal["positions", "velocities", "both"] = Field("both", description="what the messages hold")


class PoseDeviation(Model):
    """Standard deviations of a pose."""

    position: Positive = Field(0.02, description="of x and of y, m")
    heading: Positive = Field(0.02, description="rad")


class SlamChannel(Channel):
    """The poses of the SLAM."""

    delay: NonNegative = Field(0.2, description="of every message, s")
    jitter: NonNegative = Field(0.02, description="more delay, half-normal: |N(0, jitter)| for each message, s")
    period: NonNegative = Field(0.25, description="poses at least so far apart, s")
    covariance: PoseDeviation | None = Field(
        None, description="of poses that have none in the data set; default: from the noise model, or else 0.02 m, rad"
    )


def _speed(value: Any) -> Any:
    return math.inf if value == "max" else value


class ReplayConfig(Model):
    """How a recording is played."""

    speed: Annotated[float, BeforeValidator(_speed, json_schema_input_type=float | Literal["max"])] = Field(
        1.0, gt=0, description="1: as it was; 10: ten times as fast; max: as fast as it goes, without losing messages"
    )
    pause: float = Field(1.0, ge=0, le=LONGEST_PAUSE, description="rest between runs, s")
    split: Split | None = Field(None, description="play these runs only")
    seed: int = Field(0, ge=0, description="of jitter, drops and duplicates")
    wheels: WheelChannel = WheelChannel()
    slam: SlamChannel = SlamChannel()
    stamp_origin: int | None = Field(
        None, gt=0, le=_LATEST_ORIGIN, description="stamp of the recording's start, ns; default: when the replay starts"
    )
    wait: NonNegative = Field(10.0, description="how long to wait for a subscriber of the wheel samples, s; 0: play")


@dataclass(frozen=True, eq=False)
class Schedule:
    """All messages by time of arrival: arrivals (E,) s; topics (E,) index in TOPICS_PLAYED; rows (E,) of the drive."""

    arrivals: Array
    topics: NDArray[np.int8]
    rows: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.arrivals)


def make_schedule(drive: ConcatenatedDrive, config: ReplayConfig) -> Schedule:
    """When each message of a drive arrives. The same seed gives the same, and neither topic changes the other's."""
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
    """Indices (E,) of the messages that arrive, some twice, and when they do (E,)."""
    chance, jitter = rng.random((2, len(times))), np.abs(rng.standard_normal((2, len(times))))
    arrives = chance[0] >= channel.drop
    twice = arrives & (chance[1] < channel.duplicate)
    late = times + channel.delay + channel.jitter * jitter
    every = np.concatenate([np.flatnonzero(arrives), np.flatnonzero(twice)])
    when = np.concatenate([late[0][arrives], late[1][twice]])
    order = np.lexsort((every, when))
    return every[order], when[order]


def _thinned(times: Array, period: float) -> NDArray[np.intp]:
    """Indices of times that are at least ``period`` apart, from the first on."""
    kept, index = [], 0
    while index < len(times):
        kept.append(index)
        index = max(index + 1, int(np.searchsorted(times, times[index] + period - _SAME_TIME)))
    return np.array(kept, dtype=np.intp)
