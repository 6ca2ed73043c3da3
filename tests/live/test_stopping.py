"""Stopping commands by signals."""

from __future__ import annotations

import os
import signal
import threading
import time
from itertools import pairwise

import pytest
from timing import PATIENCE

from omnibench.live.stopping import stop_on_signals, ticks


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_sets_the_event_and_acts_as_before_when_it_is_over(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        os.kill(os.getpid(), number)
        assert stop.wait(PATIENCE)
    assert signal.getsignal(number) == before


def interrupted_twice() -> None:
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(PATIENCE)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)


def test_a_second_ctrl_c_interrupts() -> None:
    with pytest.raises(KeyboardInterrupt):
        interrupted_twice()


def test_ticks_come_at_once_and_then_every_period_until_the_time_is_over() -> None:
    began = time.monotonic()
    passed = list(ticks(threading.Event(), 0.1, 0.35))
    assert passed[0] == 0.0
    assert 1 <= len(passed) <= 4  # fewer when the machine is busy
    assert all(later - earlier >= 0.1 for earlier, later in pairwise(passed))
    assert passed[-1] < 0.35 <= time.monotonic() - began


def test_ticks_end_when_stopped() -> None:
    stop, seen = threading.Event(), []
    for passed in ticks(stop, 0.01):
        seen.append(passed)
        if len(seen) == 3:
            stop.set()
    assert len(seen) == 3
