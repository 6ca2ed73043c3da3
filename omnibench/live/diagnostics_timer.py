"""Diagnostics of all robots of a node, published once a second."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Sequence

from omnibench.errors import one_line
from omnibench.live.network.rate_limiter import RateLimiter
from omnibench.live.robot_service import RobotService

LOG = logging.getLogger("omnibench.live")
_PERIOD = 1.0  # s, as ROS 2's diagnostics usually come


class DiagnosticsTimer:
    """Calls the services' ``publish_diagnostics`` once a second, in a thread of its own, until ``close``.

    A robot whose diagnostics fail does not stop those of the others; each kind of its errors is logged once.
    """

    def __init__(self, services: Sequence[RobotService]) -> None:
        self._services = services
        self._log_limiter = RateLimiter(math.inf)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="diagnostics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD):
            for service in self._services:
                try:
                    service.publish_diagnostics()
                except Exception as error:
                    name, kind = service.tracker.name, type(error).__name__
                    if self._log_limiter.allows(f"{name} {kind}"):
                        LOG.error("%s: diagnostics: %s: %s", name, kind, one_line(str(error)))
