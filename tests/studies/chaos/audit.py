"""The account of a round: where each sample of a robot went, and whether the odometry equals the batch odometry.

A node numbers its odometry. Between two messages from it, numbered n and n' and of samples k and k', there are
k' - k samples and n' - n updates, so that (k' - k) - (n' - n) samples made no message: they were integrated late and
counted as ``unpublished``, refused and counted, or they never came, which the stamps tell the node (``missing``, or
``gaps`` where it was silent for long). The node's counters must say just as many.                              (C1)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from chaos.witness import Heard
from omnibench.robot.kinematics import Array, wrapped

EXACT: Final = 1e-9  # m, rad; largest difference of odom from the batch odometry
_LONGEST: Final = 100  # periods from sample to sample; beyond it, 1 s, the node counts a gap
_LEARNING: Final = 12  # samples of a new node, before it knows the period by which it counts missing ones
# Counters that say what became of a wheel message.
REFUSED: Final = (
    "duplicates",
    "late",
    "bad_stamps",
    "not_finite",
    "too_fast",
    "wrong_joints",
    "undecodable",
    "overflow",
)
POSES: Final = (
    *("poses", "pose_rejected", "pose_too_late", "pose_ahead", "pose_duplicates", "pose_invalid"),
    "pose_undecodable",
)

Counts = Mapping[str, int]


@dataclass
class Account:
    """What became of a robot's samples.

    published: came back as odometry, or its message was lost behind the node, as its number tells. unpublished:
    integrated, and only a newer pose published. refused, missing: so counted by the node. in_gaps: lost in silences
    that the node counts. unconfirmed: of a replay that said so. killed: with a node that was ended or not there.
    unaccounted: none of these. repeated: stamps that came twice. worst: difference from the batch odometry, m or rad.
    """

    sent: int = 0
    published: int = 0
    unpublished: int = 0
    refused: int = 0
    missing: int = 0
    in_gaps: int = 0
    unconfirmed: int = 0
    killed: int = 0
    unaccounted: int = 0
    repeated: int = 0
    compared: int = 0
    worst: float = 0.0
    problems: list[str] = field(default_factory=list)

    def add(self, other: Account) -> None:
        for item in fields(self):
            mine, its = getattr(self, item.name), getattr(other, item.name)
            setattr(self, item.name, max(mine, its) if item.name == "worst" else mine + its)

    def problem(self, samples: int, what: str) -> None:
        """Note samples that are not accounted for."""
        if samples:
            self.unaccounted += abs(samples)
            self.problems.append(f"{samples} {what}")


def difference(now: Counts, before: Counts | None) -> dict[str, int]:
    """Counters now less those before; None: of a node that has started since."""
    return {name: value - (0 if before is None else before[name]) for name, value in now.items()}


def refused(counts: Counts) -> int:
    """Wheel messages that were refused."""
    return sum(counts[name] for name in REFUSED)


def check_published(account: Account, last: Heard, now: Counts) -> None:
    """Every sample that a node took was published, or counted as unpublished."""
    taken = now["samples"] - now["unpublished"] - int(last.numbers[-1])
    account.problem(taken, "samples taken that were neither published nor counted as unpublished")


def check_stamps(account: Account, parts: Sequence[Heard], *, jumps: bool = False) -> None:
    """No stamp comes twice. jumps: the robot's clock goes back, and a new node cannot know what others published."""
    together = [part.stamps for part in parts] if jumps else [np.concatenate([part.stamps for part in parts])]
    repeated = sum(len(stamps) - len(np.unique(stamps)) for stamps in together)
    if repeated:
        account.repeated += repeated
        account.problems.append(f"{repeated} stamps came twice")


def check_path(account: Account, part: Heard, index: NDArray[np.int64], paths: Sequence[Array], swaps: int) -> None:
    """Odometry equals one of the batch ``paths`` (F, 3), and changes between them ``swaps`` times at most, unseen.

    index (K,): sample of each message. Stretches in which no sample was lost are compared as a whole.
    """
    samples, updates = np.diff(index), np.diff(part.numbers)
    whole = samples == updates
    moved = _moves(part.poses[:-1], part.poses[1:])
    off = np.array([np.abs(_off(moved, _moves(path[index[:-1]], path[index[1:]]))).max(axis=1) for path in paths])
    chosen, least = off.argmin(axis=0), off.min(axis=0)
    same = whole & (least <= EXACT)
    wrong = whole & ~same
    across = np.count_nonzero(wrong & (samples > 1))  # a swap may lie within a step whose messages were lost
    if np.count_nonzero(wrong) > min(across, swaps):
        place = int(np.flatnonzero(wrong)[0])
        account.problems.append(
            f"odom differs from batch by {least[wrong].max():.1e} in {np.count_nonzero(wrong)} steps without loss, "
            f"first at stamp {part.stamps[place + 1]} (message {part.numbers[place + 1]})"
        )
        account.worst = max(account.worst, float(least[wrong].max()))
    account.compared += int(np.count_nonzero(same))
    breaks = np.flatnonzero(~same | np.append(True, chosen[1:] != chosen[:-1]))
    for begin, end in zip(breaks, np.append(breaks[1:], len(same)), strict=True):
        first = begin if same[begin] else begin + 1
        if first < end:
            path = paths[chosen[first]][index[first : end + 1]]
            poses = part.poses[first : end + 1]
            drift = _off(_moves(poses[:1], poses), _moves(path[:1], path))
            account.worst = max(account.worst, float(np.abs(drift).max()))
    if account.worst > EXACT:
        account.problems.append(f"odom is off the batch odometry by {account.worst:.1e} (m, rad)")


def check_going_on(
    account: Account, pose: Array, index: NDArray[np.int64], after: Array, later: NDArray[np.int64], path: Array
) -> None:
    """Odometry of a node that takes the place of another one goes on where that one was, with nothing left out.

    pose (1, 3), index (1,): last of the node before, and its sample; after, later: first of the next one.
    """
    off = float(np.abs(_off(_moves(pose, after), _moves(path[index], path[later]))).max())
    if off > EXACT:
        account.worst = max(account.worst, off)
        account.problems.append(f"odom goes on {off:.1e} (m, rad) off the batch odometry after its node was killed")


def account_stream(
    parts: Sequence[Heard], index: Sequence[NDArray[np.int64]], now: Counts, before: Counts | None
) -> Account:
    """The account of a stream that nobody acknowledges, from the first message of ``parts`` to the last.

    index: for each part, the samples of its messages. now, before: counters of the last part's node at the end and at
    the beginning; None: it is a new node.
    """
    account = Account()
    for number, (part, samples) in enumerate(zip(parts, index, strict=True)):
        unseen = np.diff(samples) - np.diff(part.numbers)
        account.published += int(np.diff(part.numbers).sum())
        if number:  # messages of this node before the first that came
            head = int(part.numbers[0]) - 1
            account.published += head + 1
            account.killed += int(samples[0] - index[number - 1][-1]) - 1 - head
        if number < len(parts) - 1:
            account.killed += int(unseen.sum())
            continue
        counted = difference(now, before)
        account.unpublished += counted["unpublished"]
        account.refused += refused(counted)
        lost = int(unseen.sum()) - counted["unpublished"] - refused(counted)  # Eq. (C1)
        beyond = lost - counted["missing"]
        # In a silence, which is longer than a second, it counts none, nor where the clock seems to have jumped.
        silences = np.diff(samples) > _LONGEST
        long = int(unseen[silences].sum()) if counted["gaps"] + counted["clock_jumps"] else 0
        least = _LONGEST * counted["gaps"] - refused(counted)
        if before is None:  # it counts what it missed before its first message too, and not while it learns the period
            account.missing += min(counted["missing"], lost)
            early = int(unseen[part.numbers[1:] <= _LEARNING].sum())
            account.killed += min(max(beyond, 0), early)
            beyond, least = max(beyond - early, 0), 0
        else:
            account.missing += counted["missing"]
        if max(least, 0) <= beyond <= long:
            account.in_gaps += beyond
        else:
            account.problem(beyond, f"samples lost before the node, more than it counts as missing, {long} in silences")
    return account


def account_replays(
    replays: Sequence[tuple[Array, bool, bool]], parts: Sequence[Heard], now: Counts, before: Counts | None, kept: int
) -> Account:
    """The account of the replays of a round: a node takes all messages of one that ended well.

    replays: of each the stamps (F,) ns, whether it played to its end, and whether its delivery was confirmed. parts:
    begin with the last message before. kept: samples at a replay's end that a node which is killed may have taken
    without a trace; that those before are in the path of the next node, ``check_going_on`` tells.
    """
    account = Account()
    stamps = np.concatenate([each for each, _, _ in replays]) if replays else np.zeros(0, dtype=np.int64)
    covered, owner = np.zeros(len(stamps), dtype=bool), np.full(len(stamps), -1)
    counted = difference(now, before)
    for life, part in enumerate(parts):
        index = np.searchsorted(stamps, part.stamps)
        known = np.isin(part.stamps, stamps)
        if life:
            unknown = int(np.count_nonzero(~known & (part.numbers > 0)))
            account.problem(unknown, "stamps of odom that no replay has sent")
        previous = 0
        end = int(part.numbers[-1])
        if life == len(parts) - 1:
            end = now["samples"] - now["unpublished"]
        for place, number, is_known in zip(index, part.numbers, known, strict=True):
            if not is_known:
                previous = int(number)
                continue
            first = max(place - (int(number) - previous) + 1, 0)
            run = slice(first, place + 1)  # with messages of odom that were lost on their way to the witness
            covered[run], owner[run] = True, life
            previous = int(number)
        if len(index) and known[-1]:
            covered[index[-1] + 1 : index[-1] + 1 + end - int(part.numbers[-1])] = True
    begin, refusals = 0, refused(counted)
    unpublished = counted["unpublished"]
    for each, whole, confirmed in replays:
        here = slice(begin, begin + len(each))
        begin += len(each)
        sent = len(each) if whole else int(np.flatnonzero(covered[here]).max(initial=-1)) + 1
        account.sent += sent
        without = np.flatnonzero(~covered[here][:sent])
        account.published += sent - len(without)
        lives = owner[here][:sent]
        if not confirmed:
            account.unconfirmed += len(without)
            continue
        for run in np.split(without, np.flatnonzero(np.diff(without) > 1) + 1):
            if not len(run):
                continue
            around = (lives[run[0] - 1] if run[0] else -1, lives[run[-1] + 1] if run[-1] + 1 < sent else -1)
            # of a killed node: what it had taken but not yet sent out, and the next one's path must hold that
            if len(parts) > 1 and around[0] != around[1] and (min(around) >= 0 or len(run) <= kept):
                told = min(unpublished, len(run))
                account.unpublished += told
                account.killed += len(run) - told
                unpublished -= told
            elif len(run) <= unpublished:  # as another node may have done it, for all that this one knows
                account.unpublished += len(run)
                unpublished -= len(run)
            elif len(run) <= refusals:
                account.refused += len(run)
                refusals -= len(run)
            else:
                account.problem(len(run), f"samples of a replay did not come back, from stamp {each[run[0]]} on")
    return account


def _moves(begin: Array, end: Array) -> Array:
    """Motion (K, 3) from poses to poses in the frame of the first: m, m, rad."""
    dx, dy = (end - begin)[:, 0], (end - begin)[:, 1]
    cosine, sine = np.cos(begin[:, 2]), np.sin(begin[:, 2])
    return np.column_stack([cosine * dx + sine * dy, cosine * dy - sine * dx, end[:, 2] - begin[:, 2]])


def _off(moved: Array, expected: Array) -> Array:
    """Differences (K, 3) of motions, headings to the nearest turn."""
    off = moved - expected
    off[:, 2] = wrapped(off[:, 2])
    return off
