"""Requests made to exhaust a node: it refuses them and goes on integrating."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import drive
from nodes import Command, asked, peak_memory, write_node
from sessions import free_port, raw_session, until

from omnibench.live.wire.messages import JOINT_STATE

# Eight levels of aliases, nine values each, stand for 10^8; libyaml does not take this directive, Python's parser did.
_LEVELS = " ".join(f"&a{level} [{', '.join([f'*a{level - 1}'] * 9)}]," for level in range(1, 9))
BOMB = f"%YAML 1.3\n---\nx: [&a0 [1, 1, 1, 1, 1, 1, 1, 1, 1], {_LEVELS}]\ny: 0\ntheta: 0\n"
_SECONDS = 1.0  # on a busy machine; such a request took 22 s and more


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, zenoh.Session, list[float]]]:
    """The process of a node that takes samples at 100 Hz, a client's session, and when its odometry arrived."""
    port, arrivals, over = free_port(), list[float](), threading.Event()
    file = write_node(tmp_path_factory.mktemp("node"), "apr", port=port)
    with Command("live", file) as command:
        until(lambda: "apr" in command.said(), "the node's start")
        session = raw_session("client", connect=[f"tcp/127.0.0.1:{port}"])
        asked(session, "omnibench/apr/info")
        subscriber = session.declare_subscriber("apr/odom", lambda _: arrivals.append(time.monotonic()))
        publisher = session.declare_publisher("apr/joint_states")

        def drives() -> None:
            for sample in drive(60.0, period=0.01).samples():
                publisher.put(JOINT_STATE.encode(sample))
                if over.wait(0.01):
                    return

        driving = threading.Thread(target=drives)
        driving.start()
        until(lambda: len(arrivals) > 50, "odometry")
        yield command.process.pid, session, arrivals
        over.set()
        driving.join()
        subscriber.undeclare()
        session.close()


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="memory is read from /proc")
@pytest.mark.parametrize("service", ["set_pose", "swap"])
@pytest.mark.parametrize("payload", [BOMB, BOMB.partition("---\n")[2]], ids=["with a directive", "plain"])
def test_a_node_refuses_a_bomb_and_goes_on(node: Any, service: str, payload: str) -> None:
    process, session, arrivals = node
    memory, count, began = peak_memory(process), len(arrivals), time.monotonic()
    answer = asked(session, f"omnibench/apr/{service}", payload)
    refused = time.monotonic()
    until(lambda: len(arrivals) > count + 50, "odometry after the request")
    assert "not valid YAML" in answer["error"]
    assert refused - began < _SECONDS
    gaps = np.diff(arrivals[count - 1 :])
    assert max(gaps) < _SECONDS
    assert peak_memory(process) - memory < 20
