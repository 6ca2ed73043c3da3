"""Ctrl-C reaches the program at whatever moment it comes."""

from __future__ import annotations

import os
import signal
from multiprocessing import forkserver

import pytest

from omnibench.processes import one_thread_processes


def test_ctrl_c_while_the_fork_server_starts_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    started = []

    def interrupted() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        started.append(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))

    monkeypatch.setattr(forkserver, "ensure_running", interrupted)
    with pytest.raises(KeyboardInterrupt), one_thread_processes(()):
        pytest.fail("the interrupt was lost")
    assert started == [True]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_processes_of_the_fork_server_leave_ctrl_c_to_their_parent() -> None:
    with one_thread_processes(()) as context, context.Pool(1) as pool:
        blocked = pool.apply(signal.pthread_sigmask, (signal.SIG_BLOCK, ()))
    assert signal.SIGINT in blocked
