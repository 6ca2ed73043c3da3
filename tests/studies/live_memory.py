"""An hour's worth of wheel samples through a node at full speed: its memory must stay flat.

    python tests/studies/live_memory.py [--hours 1]

A node with fusion, real Zenoh sessions, 100 Hz of samples and 4 Hz of poses, sent without losing any. Prints the
node's resident memory after every tenth.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import zenoh
from live_latency import OMNI, client, node

from omnibench.live.wire import JOINT_STATE, POSE_ESTIMATE, JointState, PoseEstimate


def samples_taken(session: zenoh.Session) -> int:
    for reply in session.get("omnibench/r0/health", timeout=20.0):
        if reply.ok is not None:
            return int(json.loads(reply.ok.payload.to_bytes())["counts"]["samples"])
    return 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0)
    total = round(parser.parse_args().hours * 360_000)
    with tempfile.TemporaryDirectory() as folder:
        running, port = node(Path(folder), 1)
        try:
            session = client(port)
            block = zenoh.CongestionControl.BLOCK
            wheels = session.declare_publisher("r0/joint_states", congestion_control=block)
            poses = session.declare_publisher("r0/slam_pose", congestion_control=block)
            time.sleep(1.0)
            angles, step, stamp = np.zeros(3), 0.01 * np.array([1.0, -0.4, 0.3]), 1_800_000_000_000_000_000
            begin = time.perf_counter()
            for number in range(1, total + 1):
                angles, stamp = angles + step, stamp + 10_000_000
                wheels.put(JOINT_STATE.encode(JointState(stamp, OMNI.wheel_names, angles, None)))
                if number % 25 == 0:
                    late = PoseEstimate(stamp - 200_000_000, "map", np.zeros(3), 1e4 * np.eye(3))
                    poses.put(POSE_ESTIMATE.encode(late))
                if number % (total // 10) == 0:
                    while samples_taken(session) < number:
                        time.sleep(0.05)
                    print(f"{number} samples: {running.resident / 1e6:.1f} MB", flush=True)
            rate = total / (time.perf_counter() - begin)
            print(f"{rate:.0f} samples/s, {samples_taken(session)} of {total} taken")
            session.close()
        finally:
            running.stop()


if __name__ == "__main__":
    main()
