"""A router in a process of its own, as ``omnibench live`` would run it: its output and its log are what tests look at.

Prints ``ready``, then ``got KEY`` for what arrives at */joint_states and */slam_pose; publishes ``apr02/odom`` and
``apr03/odom``; ends with its standard input.
"""

from __future__ import annotations

import logging
import sys
import threading
from pathlib import Path

import zenoh

from omnibench.config import read_model
from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import SessionConfig


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(path: Path) -> None:
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    config = read_model(SessionConfig, path)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()

    def got(sample: zenoh.Sample) -> None:
        say(f"got {sample.key_expr}")

    with open_session(config, "router") as session:
        subscribers = [session.declare_subscriber(key, got) for key in ("*/joint_states", "*/slam_pose")]
        publishers = [session.declare_publisher(key) for key in ("apr02/odom", "apr03/odom")]
        say("ready")
        while not ended.wait(0.02):
            for publisher in publishers:
                publisher.put(b"odometry")
        del subscribers


if __name__ == "__main__":
    main(Path(sys.argv[1]))
