"""Answers to questions about a node's robots, and orders to them: ``omnibench/<robot>/<service>``, in JSON."""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import zenoh
from pydantic import Field
from zenoh.handlers import Callback

from omnibench.config import Model, parse_yaml, to_json, validate
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.live.memory import RobotMemory
from omnibench.live.tracker import RobotTracker
from omnibench.robot.calibration import parse_calibration
from omnibench.robot.kinematics import Array

LOG = logging.getLogger("omnibench.live")
_READING: Final = ("info", "calibration", "health", "pose")
_ORDERS: Final = ("set_pose", "reset", "swap")
_NANOSECONDS = 10**14  # numbers of ``at`` from here on are ns; as s they would lie three million years ahead
_LONGEST = 1 << 20  # bytes of a calibration


class PoseOrder(Model):
    """What ``set_pose`` is told: m and rad in the map."""

    x: float = Field(allow_inf_nan=False)
    y: float = Field(allow_inf_nan=False)
    theta: float = Field(allow_inf_nan=False)
    position_sigma: float = Field(0.05, gt=0, allow_inf_nan=False, description="standard deviation, m")
    heading_sigma: float = Field(0.05, gt=0, allow_inf_nan=False, description="rad")


class Desk:
    """Answers queries and takes calibrations for one robot after another, in a thread of its own.

    info: robot -> what ``info`` answers. calibrations: robot -> the file that its config names.
    """

    def __init__(
        self,
        session: zenoh.Session,
        trackers: Mapping[str, RobotTracker],
        info: Callable[[RobotTracker], Mapping[str, Any]],
        memories: Mapping[str, RobotMemory],
        calibrations: Mapping[str, Path],
    ) -> None:
        self._trackers = trackers
        self._info = info
        self._memories = memories
        self._calibrations = calibrations
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="desk", daemon=True)
        self._open: list[Any] = []
        for name in trackers:
            self._open += self._declare(session, name)
        self._thread.start()

    def close(self) -> None:
        """Answer what was asked and no more."""
        for each in self._open:
            each.undeclare()
        self._work.put(None)
        self._thread.join()

    def _declare(self, session: zenoh.Session, name: str) -> list[Any]:
        def asked(query: zenoh.Query) -> None:
            self._work.put(lambda: self._answer(query))

        def sent(sample: zenoh.Sample) -> None:
            self._work.put(lambda: self._take_calibration(name, sample))

        # declared one by one, so that access control can tell them apart
        services: list[Any] = [
            session.declare_queryable(f"omnibench/{name}/{service}", _direct(asked)) for service in _READING + _ORDERS
        ]
        return [*services, session.declare_subscriber(f"omnibench/{name}/calibration", _direct(sent))]

    def _run(self) -> None:
        while (work := self._work.get()) is not None:
            try:
                work()
            except Exception as error:  # whatever was asked, the next one is answered
                LOG.error("a question could not be answered: %s: %s", type(error).__name__, error)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            asked = query.key_expr
            for name in self._trackers:
                for service in _READING + _ORDERS:
                    key = f"omnibench/{name}/{service}"
                    exactly = str(asked) == key
                    if exactly or (service in _READING and asked.intersects(key)):
                        self._reply(query, key, name, service)
                        if exactly:
                            return

    def _reply(self, query: zenoh.Query, key: str, name: str, service: str) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        parameters = dict(cast(Iterable[tuple[str, str]], query.parameters))
        try:
            answer = self._serve(name, service, payload, parameters)
        except OmnibenchError as error:
            query.reply_err(to_json({"robot": name, "error": str(error)}), encoding=zenoh.Encoding.APPLICATION_JSON)
            return
        query.reply(key, to_json(answer), encoding=zenoh.Encoding.APPLICATION_JSON)

    def _serve(self, name: str, service: str, payload: bytes, parameters: dict[str, str]) -> Mapping[str, Any] | Model:
        tracker = self._trackers[name]
        if service == "info":
            return self._info(tracker)
        if service == "health":
            return tracker.health(time.monotonic())
        if service == "pose":
            return _pose_answer(tracker, parameters)
        if service == "calibration":
            if payload:  # a right to read it must not be one to swap it
                raise ConfigError(f"omnibench/{name}/calibration: put it there, or ask omnibench/{name}/swap with it")
            return tracker.calibration
        if service == "swap":
            return self._swap(name, payload)
        if service == "set_pose":
            order = _order(payload, parameters)
            deviations = np.array([order.position_sigma, order.position_sigma, order.heading_sigma])
            tracker.set_pose(np.array([order.x, order.y, order.theta]), np.diag(deviations**2))
            LOG.info("%s: pose set to %.3f m, %.3f m, %.1f deg", name, order.x, order.y, math.degrees(order.theta))
            return {"robot": name, "done": "set_pose"}
        tracker.reset()
        LOG.info("%s: filter reset", name)
        return {"robot": name, "done": "reset"}

    def _take_calibration(self, name: str, sample: zenoh.Sample) -> None:
        """A calibration that was put: there is nobody to answer (unlike ``swap``), so health and log tell."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            self._swap(name, sample.payload.to_bytes())
        except OmnibenchError:
            return  # told already

    def _swap(self, name: str, payload: bytes) -> Mapping[str, Any]:
        tracker = self._trackers[name]
        where = f"omnibench/{name}/calibration"
        try:
            if len(payload) > _LONGEST:
                raise DataError(f"{where}: {len(payload)} bytes are no calibration file")
            try:
                text = payload.decode()
            except UnicodeDecodeError as error:
                raise DataError(f"{where}: not a text in UTF-8: {error}") from None
            calibration = parse_calibration(text, where)
        except DataError as error:
            tracker.refuse_swap(str(error))
            LOG.warning("%s: calibration refused, %s runs on: %s", name, tracker.calibration.name, error)
            raise
        try:
            tracker.swap(calibration)
        except DataError as error:
            LOG.warning("%s: calibration refused, %s runs on: %s", name, tracker.calibration.name, error)
            raise
        LOG.info("%s: calibration %r runs", name, calibration.name)
        if name in self._memories:
            self._memories[name].keep_calibration(calibration, self._calibrations[name])
        return {"robot": name, "accepted": True, "calibration": calibration.name}


def _direct(callback: Callable[[Any], None]) -> Any:
    return Callback(callback, indirect=False)


def _order(payload: bytes, parameters: dict[str, str]) -> PoseOrder:
    where = "set_pose"
    if not payload:
        return validate(PoseOrder, parameters, where)
    try:
        content = parse_yaml(payload.decode(), where)  # of which JSON is a part
    except UnicodeDecodeError:
        raise ConfigError(f"{where}: the payload is not text; send x, y (m) and theta (rad) in JSON") from None
    return validate(PoseOrder, content, where)


def _pose_answer(tracker: RobotTracker, parameters: dict[str, str]) -> Mapping[str, Any]:
    found = tracker.pose_at(_time(parameters["at"]) if "at" in parameters else None)
    answer: dict[str, Any] = {"robot": tracker.name, "at": found.stamp / 1e9, "at_ns": found.stamp}
    answer["odom"] = _planar(found.odometry)
    answer["map"] = None
    if found.in_map is not None:
        pose, covariance = found.in_map
        answer["map"] = _planar(pose) | {"covariance": covariance.tolist()}
    return answer


def _planar(pose: Array) -> dict[str, float]:
    x, y, theta = pose.tolist()
    return {"x": x, "y": y, "theta": theta}


def _time(text: str) -> int:
    """A time in s (or ns, if it is that large) as ns, without going through a float, which has steps of 0.2 us."""
    try:
        number = Decimal(text)
        nanoseconds = int(number) if abs(number) >= _NANOSECONDS else int((number * 10**9).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError):
        raise ConfigError(f"at: {text!r} is not a time; give s since 1970, as 1800000000.25") from None
    return nanoseconds
