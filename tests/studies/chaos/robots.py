"""The robots: what they drive, the samples that they send, and their batch odometry."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import zenoh

from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.live.drive import concatenate_runs
from omnibench.live.network import is_connected
from omnibench.live.topics import GraphNode
from omnibench.live.wire import JOINT_STATE, POSE_ESTIMATE, JointState, PoseEstimate
from omnibench.robot.calibration import Calibration, Noise, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog
from omnibench.testing.synthetic import synthetic_robot, true_robot

PERIOD: Final = 0.01  # s between two wheel samples
STEP: Final = 10_000_000  # ns, the same
ORIGIN: Final = 1_800_000_000 * 10**9  # ns, stamp of the first sample
RECORDING: Final = 80.0  # s that a recording takes; chosen
WHEELS: Final = ("a", "b", "c")
_NOISE = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.003, walk_heading=0.003)


def calibrations() -> tuple[Calibration, Calibration]:
    """Two calibrations of one robot, between which a swap can choose."""
    robot = synthetic_robot()
    matrix = true_robot(robot).inverse_kinematic_matrix
    one, other = (
        Calibration(
            name=f"chaos {scale:g}",
            robot=robot,
            sample_period=PERIOD,
            matrix=matrix_rows(scale * matrix),
            integration="arc",
            noise=_NOISE,
            covariance=tuple(tuple(row) for row in (1e-8 * np.eye(9)).tolist()),
        )
        for scale in (1.0, 1.05)
    )
    return one, other


def batch(calibration: Calibration, stamps: Sequence[int], angles: Array) -> Array:
    """Batch odometry (F, 3) from the origin at stamps (F,) ns, from the wheel angles (F, N) rad."""
    times = (np.array(stamps[1:]) - stamps[0]) / 1e9
    rates = np.diff(angles, axis=0) / np.diff(times, prepend=0.0)[:, None]
    log = WheelLog(times, rates, np.zeros(3), np.append(0.0, times))
    return calibration.model.poses([log])[0]


def write_recording(folder: Path, rng: np.random.Generator, calibration: Calibration) -> tuple[Array, Array]:
    """Write a data set of one lively run; times (F,) s of its samples in a replay, and their batch odometry (F, 3)."""
    count = round(RECORDING / PERIOD)
    times = PERIOD * np.arange(1, count + 1)
    rates = 1.5 * np.sin(0.8 * times[:, None] + rng.uniform(0, 6, 3)) + 0.3 + 0.2 * rng.standard_normal((count, 3))
    posed = np.append(0.0, times[9::10])
    (poses,) = calibration.model.poses([WheelLog(times, rates, np.zeros(3), posed)])
    run = Trajectory("drive", "train", times, rates, posed, poses)
    save_dataset(make_dataset("chaos", calibration.robot, PERIOD, [run]), folder)
    drive = concatenate_runs(load_dataset(folder))
    return drive.wheel_times, calibration.model.poses([drive.log()])[0]


class Robot(threading.Thread, ABC):
    """A robot that sends a wheel sample every 10 ms, whatever becomes of it, while ``driving`` is set.

    Its stamps go on by 10 ms from sample to sample, also where this process comes late. jump: moves the stamps from now
    on, s. sent: (stamp ns, angles) of all samples since ``forget``.
    """

    def __init__(self, name: str, seed: int, period: float = PERIOD) -> None:
        super().__init__(name=name, daemon=True)
        self.driving = threading.Event()
        self.sent: list[tuple[int, Array]] = []
        self.total = 0
        self.failed = ""
        self._rng = np.random.default_rng(seed)
        self._period = period
        self._closed = threading.Event()
        self._lock = threading.Lock()  # held while a sample is sent
        self._stamp, self._angles = ORIGIN, np.zeros(3)
        self._phase = self._rng.uniform(0, 6, 3)

    @abstractmethod
    def publish(self, payload: bytes) -> None:
        """Put a sample on the network."""

    def jump(self, seconds: float) -> None:
        with self._lock:
            self._stamp += round(seconds * 1e9)

    def pause(self) -> None:
        """Send nothing more; what was begun is sent."""
        self.driving.clear()
        with self._lock:
            pass

    def send_one(self) -> None:
        with self._lock:
            time_now = self.total * PERIOD
            rates = 1.5 * np.sin(0.8 * time_now + self._phase) + 0.2 + 0.2 * self._rng.standard_normal(3)
            self._stamp += STEP
            self._angles = self._angles + PERIOD * rates
            self.sent.append((self._stamp, self._angles))
            self.total += 1
            self.publish(JOINT_STATE.encode(JointState(self._stamp, WHEELS, self._angles, rates)))

    def forget(self) -> None:
        """Forget all samples but the last one."""
        del self.sent[:-1]

    def run(self) -> None:
        due = time.monotonic()
        while not self._closed.is_set():
            if not self.driving.wait(0.1):
                due = time.monotonic()
                continue
            try:
                self.send_one()
            except zenoh.ZError as error:
                self.failed = str(error)
                return
            due = max(due + self._period, time.monotonic() - 1.0)
            time.sleep(max(due - time.monotonic(), 0.0))

    def close(self) -> None:
        self._closed.set()
        self.join()


class NumberingRobot(Robot):
    """A robot whose messages carry numbers, sent through a router whose links are cut."""

    def __init__(self, name: str, seed: int, graph: GraphNode) -> None:
        super().__init__(name, seed)
        self.losing = 0.0  # share of the samples that its radio loses
        self._publisher: Any = graph.publisher(name, "joint_states")

    def publish(self, payload: bytes) -> None:
        number = self._publisher.next_number()
        if self._rng.random() >= self.losing:
            self._publisher.put_numbered(payload, number)


class PlainRobot(Robot):
    """A robot of another program, without attachments, connected to the node itself; its SLAM sends poses and junk."""

    def __init__(self, name: str, seed: int, session: zenoh.Session) -> None:
        super().__init__(name, seed, 2 * PERIOD)
        block: Any = zenoh.CongestionControl.BLOCK
        self._wheels = session.declare_publisher(f"{name}/joint_states", congestion_control=block)
        self._slam = session.declare_publisher(f"{name}/slam_pose", congestion_control=block)
        self.junk = 0  # messages of junk on joint_states since ``forget``
        self.lost_link = False  # since ``forget``: what it then sent, nobody can count
        self._session = session

    def publish(self, payload: bytes) -> None:
        self.lost_link |= not is_connected(self._session)
        self._wheels.put(payload)
        if self.total % 25 == 0:
            pose = PoseEstimate(self._stamp - 200_000_000, "map", np.zeros(3), 1e4 * np.eye(3))
            self._slam.put(POSE_ESTIMATE.encode(pose))

    def send_junk(self, count: int) -> None:
        with self._lock:
            self.junk += count
            for number in range(count):
                junk = self._rng.bytes(int(self._rng.integers(0, 600)))
                self._wheels.put(junk)
                if number % 2:
                    self._slam.put(junk)

    def forget(self) -> None:
        super().forget()
        self.junk, self.lost_link = 0, False
