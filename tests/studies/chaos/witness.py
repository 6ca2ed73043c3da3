"""The witness: a session at the node's own port that takes down what the node publishes, acknowledges and counts."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zenoh
from zenoh.handlers import Callback

from omnibench.live.network import SessionConfig, open_session
from omnibench.robot.kinematics import Array

# A message's number, time of publishing and publisher, as rmw_zenoh's attachment has them.
_HEAD: Final = struct.Struct("<qqB16s")
_STAMP: Final = struct.Struct("<iI")
_NUMBERS: Final = 7 + 36 + 6 + 36  # float64 values at the end of an Odometry: pose, covariance, twist, covariance
_EXPECTED: Final = struct.Struct("<Q")  # what an acknowledgement begins with: the number expected next


@dataclass(frozen=True, eq=False)
class Heard:
    """Odometry that came from one node, in its order: numbers and stamps (K,) ns, poses (K, 3).

    node: a name of the process, which another start does not share.
    """

    node: bytes
    numbers: Array
    stamps: Array
    poses: Array

    def joined(self, later: Heard) -> Heard:
        """This and what came later from the same node."""
        return Heard(
            self.node,
            np.concatenate([self.numbers, later.numbers]),
            np.concatenate([self.stamps, later.stamps]),
            np.concatenate([self.poses, later.poses]),
        )


@dataclass
class Flow:
    """Messages of a replay that nodes acknowledge. since: when the first was, s, monotonic; taken: how many so far."""

    since: float
    taken: int = 0


class Witness:
    """Listens until ``close``; what it has heard is given out, and forgotten, by ``heard``."""

    def __init__(self, port: int) -> None:
        config = SessionConfig(mode="client", connect=(f"tcp/127.0.0.1:{port}",), wait=300.0)
        self.session = open_session(config, "chaos")
        self.messages = 0
        self._odometry: dict[str, list[tuple[bytes, int, bytes]]] = defaultdict(list)
        self._flows: dict[str, Flow] = {}
        self._lock = threading.Lock()
        self._subscribers = [
            self.session.declare_subscriber("*/odom", Callback(self._odom, indirect=False)),
            self.session.declare_subscriber("omnibench/*/received/*", Callback(self._received, indirect=False)),
        ]

    def latest(self, robot: str) -> int | None:
        """Stamp (ns) of the newest odometry that came."""
        with self._lock:
            messages = self._odometry[robot]
            payload = messages[-1][2] if messages else None
        return None if payload is None else _stamp(payload)

    def heard(self, robot: str) -> list[Heard]:
        """The odometry of a robot since the last call, one part for each node in the order of their lives."""
        with self._lock:
            messages, self._odometry[robot] = self._odometry[robot], []
        parts: dict[bytes, list[tuple[int, bytes]]] = {}
        for node, number, payload in messages:
            parts.setdefault(node, []).append((number, payload))
        return [
            Heard(
                node,
                np.array([number for number, _ in part]),
                np.array([_stamp(payload) for _, payload in part]),
                np.array([_pose(payload) for _, payload in part]),
            )
            for node, part in parts.items()
        ]

    def flows(self) -> list[Flow]:
        """The flows that nodes have acknowledged since the last call, in the order of their beginnings."""
        with self._lock:
            flows, self._flows = self._flows, {}
        return list(flows.values())

    def counts(self, robot: str, patience: float = 5.0) -> dict[str, int] | None:
        """The node's counters of a robot; None: no answer."""
        answer = self.asked(f"omnibench/{robot}/health", patience=patience)
        return None if answer is None or "counts" not in answer else answer["counts"]

    def alive(self) -> bool:
        """True if the node runs its robots."""
        return any(reply.ok is not None for reply in self.session.liveliness().get("omnibench/*/alive", timeout=1.0))

    def asked(self, selector: str, payload: bytes | None = None, patience: float = 5.0) -> dict[str, Any] | None:
        """The node's answer to a query, ``error`` in it if it was refused; None: there is none."""
        source = zenoh.SourceInfo(self.session.id, 0)
        try:
            for reply in self.session.get(selector, payload=payload, timeout=patience, source_info=source):
                answer = reply.ok if reply.ok is not None else reply.err
                if answer is not None and answer.payload.to_bytes() != b"Timeout":
                    return json.loads(answer.payload.to_bytes())
        except zenoh.ZError:
            pass
        return None

    def close(self) -> None:
        self.session.close()

    def _odom(self, sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        if attachment is None:
            return
        number, _, _, node = _HEAD.unpack_from(attachment.to_bytes())
        payload = sample.payload.to_bytes()
        with self._lock:
            self.messages += 1
            # of the payload only what is looked at: its stamp, and the pose
            begin = len(payload) - 8 * _NUMBERS
            kept = payload[4:12] + payload[begin : begin + 56]
            self._odometry[str(sample.key_expr).split("/")[0]].append((node, number, kept))

    def _received(self, sample: zenoh.Sample) -> None:
        flow = str(sample.key_expr).rpartition("/")[2]
        (expected,) = _EXPECTED.unpack_from(sample.payload.to_bytes())
        with self._lock:
            known = self._flows.setdefault(flow, Flow(time.monotonic()))
            known.taken = max(known.taken, expected)


def _stamp(kept: bytes) -> int:
    seconds, nanoseconds = _STAMP.unpack_from(kept)
    return seconds * 10**9 + nanoseconds


def _pose(kept: bytes) -> tuple[float, float, float]:
    x, y, _, _, _, sine, cosine = struct.unpack_from("<7d", kept, 8)
    return x, y, 2 * float(np.arctan2(sine, cosine))
