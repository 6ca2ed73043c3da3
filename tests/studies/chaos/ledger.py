"""The ledger: the account of every robot's samples, carried on from round to round."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np

from chaos.audit import (
    POSES,
    Account,
    account_replays,
    account_stream,
    check_going_on,
    check_path,
    check_published,
    check_stamps,
    difference,
    refused,
)
from chaos.programs import PATIENCE
from chaos.robots import ORIGIN, STEP, batch
from chaos.system import NUMBERED, PLAIN, PLAYED, System
from chaos.witness import Heard
from omnibench.live.delivery import WINDOW

ROBOTS: Final = (PLAYED, NUMBERED, PLAIN)
_KEPT: Final = 600  # messages at a replay's end that a kill may leave without a trace: a window and a batch


class Ledger:
    """Accounts of all robots since the beginning."""

    def __init__(self, system: System) -> None:
        self.accounts = {name: Account() for name in ROBOTS}
        self._system = system
        self._counts: dict[str, dict[str, int]] = {}  # of each robot at the end of the last round
        self._last: dict[str, Heard] = {}  # the last message of each robot in the last round
        self._node_starts = 0  # until the last round
        self._endings = 0  # of processes, until the last round

    def close_round(self) -> list[str]:
        """Add the account of a round, in which everything has come to rest; its problems."""
        system, problems = self._system, []
        for name in ROBOTS:
            now = self._settled_counts(name)
            if now is None:
                problems.append(f"the node does not answer omnibench/{name}/health after all faults have ended")
                continue
            parts = system.witness.heard(name)
            if parts or name in self._last:
                problems += [f"robot {name}: {problem}" for problem in self._account_of(name, parts, now)]
        self._node_starts = system.node.starts
        self._endings = len(system.endings)
        system.replays.clear()
        system.swaps = 0
        system.disk_was_full = False
        return problems

    def _settled_counts(self, robot: str) -> dict[str, int] | None:
        """The node's counters of a robot, once they do not change any more."""
        deadline, before = time.monotonic() + PATIENCE, None
        while time.monotonic() < deadline:
            now = self._system.witness.counts(robot)
            if now is not None and now == before:
                return now
            before = now
            time.sleep(0.5)
        return None

    def _account_of(self, name: str, parts: list[Heard], now: dict[str, int]) -> list[str]:
        """Add the account of one robot; its problems. now: the node's counters."""
        last = self._last.get(name)
        if last is None:  # nothing came before the first sample
            last = Heard(b"", np.array([0]), np.array([ORIGIN]), np.zeros((1, 3)))
        if parts and parts[0].node == last.node:
            parts[0] = last.joined(parts[0])
        else:
            parts.insert(0, last)
        if now["samples"] == 0 and parts[-1].numbers[-1]:  # a new node, which has heard nothing of this robot
            parts.append(Heard(b"new", np.array([0]), np.array([0]), np.zeros((1, 3))))
        before = self._counts.get(name) if self._node_starts == self._system.node.starts else None
        if name == PLAIN:
            account = self._plain(parts, now, before)
        else:
            account = {PLAYED: self._played, NUMBERED: self._numbered}[name](parts, now, before)
        check_stamps(account, parts, jumps=name == PLAIN)
        self.accounts[name].add(account)
        end = parts[-1]
        self._last[name] = Heard(end.node, end.numbers[-1:], end.stamps[-1:], end.poses[-1:])
        self._counts[name] = now
        return account.problems

    def _numbered(self, parts: list[Heard], now: dict[str, int], before: dict[str, int] | None) -> Account:
        robot = self._system.numbered
        stamps = [stamp for stamp, _ in robot.sent]
        angles = np.array([angles for _, angles in robot.sent])
        index = [(part.stamps - stamps[0]) // STEP for part in parts]
        account = account_stream(parts, index, now, before)
        account.sent = len(stamps) - (NUMBERED in self._last)
        paths = [batch(calibration, stamps, angles) for calibration in self._system.calibrations]
        for part, samples in zip(parts, index, strict=True):
            known = (samples >= 0) & (samples < len(stamps))
            account.problem(int(np.count_nonzero(~known[NUMBERED not in self._last :])), "stamps that were never sent")
            if known.all() and len(samples) > 1:
                check_path(account, part, samples, paths, self._system.swaps)
        check_published(account, parts[-1], now)
        told = account.published + account.unpublished + account.refused + account.missing + account.in_gaps
        account.problem(account.sent - told - account.killed - account.unaccounted, "samples in no column")
        robot.forget()
        return account

    def _plain(self, parts: list[Heard], now: dict[str, int], before: dict[str, int] | None) -> Account:
        robot, account = self._system.plain, Account()
        counted = difference(now, before)
        account.sent = len(robot.sent) - (PLAIN in self._last) + robot.junk
        account.published = int(parts[0].numbers[-1] - parts[0].numbers[0]) + sum(int(p.numbers[-1]) for p in parts[1:])
        account.unpublished, account.refused = counted["unpublished"], refused(counted)
        check_published(account, parts[-1], now)
        rest = account.sent - account.published - account.unpublished - account.refused
        if before is None or robot.lost_link:
            account.killed = rest
        else:
            account.problem(rest, "messages neither taken nor refused")
        robot.forget()
        return account

    def _played(self, parts: list[Heard], now: dict[str, int], before: dict[str, int] | None) -> Account:
        system = self._system
        endings = [each for each in system.endings[self._endings :] if each.program == "replay"]
        flows = system.witness.flows()
        ends = [*(replay.since for replay in system.replays), math.inf][1:]
        replays, contradictions = [], []
        for replay, ending, end in zip(system.replays, endings, ends, strict=True):
            stamps = replay.origin + np.round(system.times * 1e9).astype(np.int64)
            taken = [flow.taken for flow in flows if replay.since <= flow.since < end]
            confirmed = "all taken by the node" in ending.said if ending.code == 0 else bool(taken)
            replays.append((stamps, ending.code == 0, confirmed))
            # a window of a replay that was killed can come late, while the next one finds no node
            if ending.code == 0 and ((confirmed and not taken) or (not confirmed and max(taken, default=0) > WINDOW)):
                contradictions.append(
                    f"acknowledged {sum(taken)}, and the replay says {ending.said.splitlines()[-1]!r}"
                )
        account = account_replays(replays, parts, now, before, _KEPT)
        account.problems += contradictions
        counted = difference(now, before)
        handled = counted["samples"] + sum(counted[name] for name in POSES) + refused(counted)
        if before is not None and all(confirmed for _, _, confirmed in replays):
            taken = sum(flow.taken for flow in flows)
            account.problem(taken - handled, "messages acknowledged, but neither taken nor refused")
        for stamps, _, confirmed in replays:
            previous = None
            for part in parts:
                inside = (part.stamps >= stamps[0]) & (part.stamps <= stamps[-1])
                if not inside.any():
                    continue
                chosen = Heard(part.node, part.numbers[inside], part.stamps[inside], part.poses[inside])
                index = np.searchsorted(stamps, chosen.stamps)
                if len(index) > 1:
                    check_path(account, chosen, index, [system.played_path], 0)
                # what nobody acknowledges is lost with its node, and the odometry of the next one lacks it
                if confirmed and previous is not None and not system.disk_was_full:
                    check_going_on(account, *previous, chosen.poses[:1], index[:1], system.played_path)
                previous = chosen.poses[-1:], index[-1:]
        return account
