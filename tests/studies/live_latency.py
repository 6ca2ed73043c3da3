"""Latency of the live node between processes on loopback, relative to a bare Zenoh echo in the same run.

    python tests/studies/live_latency.py [--seconds 20] [--robots 50]

1. 100 Hz: from a wheel sample's put to its odometry in a subscriber, fusion on and SLAM poses 200 ms late, and the
   same for as many bytes through a process that only echoes, sample by sample in turn: three omni wheels, and a swerve
   base, whose messages have four wheels and four steering joints.
2. 1 kHz: samples that a FIFO subscriber misses (none).
3. Many robots at 100 Hz in one node: the share of a core that the node's process needs, and its latency.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
import zenoh
from zenoh.handlers import Callback, FifoChannel

from omnibench.live.wheels import joints_of
from omnibench.live.wire import JOINT_STATE, POSE_ESTIMATE, JointState, PoseEstimate
from omnibench.robot.calibration import Calibration, Noise, matrix_rows, write_calibration
from omnibench.robot.kinematics import Robot as Base
from omnibench.testing.synthetic import synthetic_robot

OMNI = synthetic_robot()
CORNERS = {"fl": (0.2, 0.15), "fr": (0.2, -0.15), "rl": (-0.2, 0.15), "rr": (-0.2, -0.15)}
SWERVE = Base.model_validate(
    {
        "name": "swerve",
        "wheels": [{"name": n, "type": "steered", "radius": 0.05, "x": x, "y": y} for n, (x, y) in CORNERS.items()],
    }
)
ECHO = """
import json, sys, zenoh
from zenoh.handlers import Callback
config = zenoh.Config.from_json5(sys.argv[1])
session = zenoh.open(config)
publisher = session.declare_publisher(
    "echo/out", congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.INTERACTIVE_HIGH
)
answer = bytes(724)
def echo(sample):
    publisher.put(sample.payload.to_bytes()[:8] + answer[8:])
session.declare_subscriber("echo/in", Callback(echo, indirect=False))
sys.stdin.read()
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def raw(mode: str, port: int) -> str:
    endpoints = [f"tcp/127.0.0.1:{port}"]
    return json.dumps(
        {
            "mode": mode,
            "listen": {"endpoints": endpoints if mode == "router" else []},
            "connect": {"endpoints": endpoints if mode == "client" else []},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
    )


def client(port: int) -> zenoh.Session:
    for _ in range(100):
        try:
            return zenoh.open(zenoh.Config.from_json5(raw("client", port)))
        except zenoh.ZError:
            time.sleep(0.1)
    raise SystemExit("the process to be measured does not come up")


class Process:
    """A process that ends when its standard input does, and the processor time that it has used."""

    def __init__(self, *command: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, *command], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, env=os.environ
        )

    @property
    def seconds(self) -> float:
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    @property
    def resident(self) -> int:
        """Bytes in memory."""
        pages = int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(10)


def node(folder: Path, robots: int, robot: Base = OMNI) -> tuple[Process, int]:
    """`omnibench live` with so many robots, fusion on."""
    port = free_port()
    noise = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.01, walk_heading=0.01)
    calibration = Calibration(
        name="benchmark",
        robot=robot,
        sample_period=0.01,
        matrix=matrix_rows(robot.inverse_kinematic_matrix),
        integration="arc",
        noise=noise,
        covariance=tuple(tuple(row) for row in (1e-8 * np.eye(3 * len(robot.drive.names))).tolist()),
    )
    write_calibration(calibration, folder / "calibration.yaml")
    config = {
        "robots": [{"name": f"r{k}", "calibration": "calibration.yaml"} for k in range(robots)],
        "fusion": "ekf",
        "zenoh": {"mode": "router", "listen": [f"tcp/127.0.0.1:{port}"]},
    }
    file = folder / f"node{robots}.yaml"
    file.write_text(yaml.safe_dump(config))
    return Process("-m", "omnibench", "live", str(file)), port


class Robot:
    """Sends wheel samples and late SLAM poses; remembers when each odometry came.

    Messages are patched rather than encoded, so that this process, which shares the machine with the node, is light.
    """

    def __init__(self, session: zenoh.Session, name: str, base: Base = OMNI) -> None:
        self.sent: dict[bytes, int] = {}
        self.delays: list[float] = []
        names, steered = joints_of(base).names, len(base.drive.steered)
        self._count, self._angles = 0, np.zeros(len(names))
        self._rates = np.append(np.resize([1.0, -0.4, 0.3], len(names) - steered), np.full(steered, 0.02))
        self._wheels = session.declare_publisher(f"{name}/joint_states", priority=zenoh.Priority.INTERACTIVE_HIGH)
        self._slam = session.declare_publisher(f"{name}/slam_pose")
        marks = 1.25 * 2.0 ** np.arange(len(names))
        marked = JOINT_STATE.encode(JointState(0, names, marks, self._rates))
        self._template = bytearray(marked)
        self._place = marked.index(marks.tobytes())
        self._subscriber = session.declare_subscriber(f"{name}/odom", Callback(self._came, indirect=False))

    @property
    def size(self) -> int:
        """Bytes of a wheel sample."""
        return len(self._template)

    def send(self, period: float) -> None:
        self._count += 1
        self._angles = self._angles + period * self._rates
        stamp = time.time_ns()
        encoded = struct.pack("<iI", stamp // 10**9, stamp % 10**9)
        self._template[4:12] = encoded
        self._template[self._place : self._place + self._angles.nbytes] = self._angles.tobytes()
        self.sent[encoded] = time.perf_counter_ns()
        self._wheels.put(bytes(self._template))
        if self._count % round(0.25 / period) == 0:
            late = PoseEstimate(stamp - 200_000_000, "map", np.zeros(3), np.eye(3))
            self._slam.put(POSE_ESTIMATE.encode(late))

    def _came(self, sample: zenoh.Sample) -> None:
        now = time.perf_counter_ns()
        begin = self.sent.get(sample.payload.to_bytes()[4:12])
        if begin is not None:
            self.delays.append((now - begin) / 1e6)


def pace(period: float, count: int) -> Iterator[int]:
    """Sleeps to the beginning of each period."""
    begin = time.perf_counter()
    for number in range(count):
        rest = begin + number * period - time.perf_counter()
        if rest > 0:
            time.sleep(rest)
        yield number


def quantiles(delays: list[float]) -> tuple[float, float]:
    return float(np.percentile(delays, 50)), float(np.percentile(delays, 99))


def latency(folder: Path, seconds: float, base: Base) -> None:
    running, port = node(folder, 1, base)
    echo_port = free_port()
    echo = Process("-c", ECHO, raw("router", echo_port))
    try:
        session, echo_session = client(port), client(echo_port)
        robot, delays = Robot(session, "r0", base), []
        echo_session.declare_subscriber(
            "echo/out",
            Callback(
                lambda sample: delays.append(
                    (time.perf_counter_ns() - int.from_bytes(sample.payload.to_bytes()[:8], "little")) / 1e6
                ),
                indirect=False,
            ),
        )
        out = echo_session.declare_publisher("echo/in", priority=zenoh.Priority.INTERACTIVE_HIGH)
        time.sleep(1.0)
        for number in pace(0.005, round(seconds / 0.005)):
            if number % 2:
                out.put(time.perf_counter_ns().to_bytes(8, "little") + bytes(robot.size - 8))
            else:
                robot.send(0.01)
        time.sleep(0.5)
        (median, worst), (echo_median, echo_worst) = quantiles(robot.delays), quantiles(delays)
        print(f"{base.name}, 100 Hz, {len(robot.delays)} of {len(robot.sent)} samples came back, fusion on")
        print(f"  wheel sample to odometry: p50 {median:.3f} ms, p99 {worst:.3f} ms")
        print(f"  bare echo:                p50 {echo_median:.3f} ms, p99 {echo_worst:.3f} ms")
        print(f"  ratios:                   p50 {median / echo_median:.2f}, p99 {worst / echo_worst:.2f}")
        session.close()
        echo_session.close()
    finally:
        running.stop()
        echo.stop()


def lossless(folder: Path, seconds: float) -> None:
    running, port = node(folder, 1)
    try:
        session = client(port)
        robot = Robot(session, "r0")
        other = client(port)
        came: list[bytes] = []
        fifo = other.declare_subscriber("r0/odom", FifoChannel(10_000))
        reading = threading.Thread(target=lambda: came.extend(s.payload.to_bytes()[4:12] for s in fifo))
        reading.start()
        time.sleep(1.0)
        for _ in pace(0.001, round(seconds / 0.001)):
            robot.send(0.001)
        time.sleep(1.0)
        fifo.undeclare()
        reading.join(5)
        median, worst = quantiles(robot.delays)
        lost = len(set(robot.sent) - set(came))
        print(f"1 kHz, {len(robot.sent)} samples: {lost} lost; p50 {median:.3f} ms, p99 {worst:.3f} ms")
        other.close()
        session.close()
    finally:
        running.stop()


def fleet(folder: Path, seconds: float, robots: int) -> None:
    running, port = node(folder, robots)
    try:
        session = client(port)
        fleet = [Robot(session, f"r{k}") for k in range(robots)]
        time.sleep(3.0)
        begin, used = time.perf_counter(), running.seconds
        turns = round(seconds / 0.01)
        for turn in pace(0.01 / robots, turns * robots):
            fleet[turn % robots].send(0.01)
        spent, elapsed = running.seconds - used, time.perf_counter() - begin
        time.sleep(0.5)
        delays = [delay for robot in fleet for delay in robot.delays]
        rate = sum(len(robot.sent) for robot in fleet) / elapsed / robots
        median, worst = quantiles(delays)
        share = spent / elapsed
        print(
            f"{robots} robots at {rate:.0f} Hz: {len(delays)} of {sum(len(r.sent) for r in fleet)} came back, "
            f"{share:.0%} of a core, so {robots * rate / 100 / share:.0f} robots at 100 Hz a core; "
            f"p50 {median:.2f} ms, p99 {worst:.2f} ms"
        )
        session.close()
    finally:
        running.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--robots", type=int, default=50)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for base in (OMNI, SWERVE):
            latency(Path(folder), arguments.seconds, base)
        lossless(Path(folder), arguments.seconds / 2)
        fleet(Path(folder), arguments.seconds / 2, arguments.robots)


if __name__ == "__main__":
    main()
