"""Clean logs: what `omnibench check` claims of simulated recordings in which nothing is wrong.

    python tests/studies/clean_logs.py [--count 700] [--seed 1] [--jobs N] [--keep DIR]

As many logs of each of seven classes of robots, 8 to 12 short runs each: geometry within 2 % of robot.yaml (wheels that
skid turn the robot up to 40 % less), random speeds, rates and noises, some with coarse counts, some whose motion walks.
No code of omnibench makes them. Prints for each class how many logs have a finding of severity error (wanted: none) and
a false warning, then for each kind the share of logs with a false warning (wanted: at most 1 %), and seconds a check.
What may be true of such logs, as too few repetitions, is counted by itself.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from strangers.faults import counts
from strangers.files import write_tables
from strangers.motion import CLASSES, Robot, changed, commands, design, simulate

ROOT = Path(__file__).resolve().parents[2]
MAY_BE_TRUE = ("few_repetitions", "few_runs", "motion_missing")
_SHAPES = ((4, 2), (4, 3), (3, 3), (3, 4), (5, 2))  # commands, and runs of each


@dataclass(frozen=True)
class Checked:
    """What check said of a log: severity and kind of each finding."""

    robot: str
    number: int
    said: tuple[tuple[str, str, str], ...]
    seconds: float


def really(robot: Robot, rng: np.random.Generator) -> Robot:
    """The robot as it is: each radius and the arms within 2 %."""
    for wheel in robot["wheels"]:
        robot = changed(robot, {"radius": rng.uniform(0.98, 1.02)}, wheel["name"])
    arms = rng.uniform(1.0, 1.4) if robot.get("skid") else rng.uniform(0.98, 1.02)
    return changed(robot, {"y": arms, "x": rng.uniform(0.98, 1.02), "distance": arms})


def write_log(kind: str, seed: int, folder: Path) -> list[str]:
    """A log of a class; the options to type."""
    rng = np.random.default_rng(seed)
    x, v = rng.uniform(0.15, 0.6), rng.uniform(0.2, 0.8)
    arms = {"x": x, "y": rng.uniform(0.08, 0.35), "distance": rng.uniform(0.1, 0.35)}
    robot = design(kind, radius=rng.uniform(0.03, 0.1), **arms)
    w = rng.uniform(0.5, 1.2)
    w = min(w, 1.6 * v / x) if kind in ("tricycle", "car") else w  # wheels steer up to about 40 degrees
    number, repeats = _SHAPES[rng.integers(len(_SHAPES))]
    motions = commands(kind, v, w, rng.uniform(3.0, 8.0))
    first = ["ahead", "arc_left", "arc_right"]  # what tells most
    others = rng.permutation([name for name in motions if name not in first]).tolist()
    motions = {name: motions[name] for name in (first + others)[:number]}
    walk = rng.uniform(0.003, 0.006) if rng.random() < 0.3 else rng.uniform(0.0005, 0.002)
    log = simulate(
        robot, seed, motions, true=really(robot, rng), repeats=repeats, rest=rng.uniform(0.8, 2.0), walk=walk,
        hz=float(rng.choice([10, 20, 25, 50, 100])), pose_hz=float(rng.choice([2, 5, 10, 20, 30, 100])),
        noise=rng.uniform(0.0005, 0.005),
    )  # fmt: skip
    pattern = r"command_pattern=(.*)_\d"
    per_turn = rng.integers(16, 60) if (chance := rng.random()) < 0.3 else rng.integers(256, 4096)
    if chance > 0.6:
        write_tables(log, folder)
        return ["wheel_unit=rad", pattern]
    counts(log, rng, int(per_turn))
    write_tables(log, folder, "ticks")
    return ["wheel_unit=ticks", f"ticks_per_turn={per_turn}", pattern]


def checked(kind: str, number: int, seed: int, folder: Path) -> Checked:
    """Write a log, type `omnibench check`, and read what it says."""
    options = write_log(kind, seed * 100_000 + CLASSES.index(kind) * 10_000 + number, folder)
    words = [
        sys.executable,
        "-m",
        "omnibench",
        "check",
        str(folder),
        *(w for o in options for w in ("--set", o)),
        "--json",
    ]
    begin = time.monotonic()
    ended = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    seconds = time.monotonic() - begin
    (folder / "typed.txt").write_text(shlex.join(words))
    if ended.returncode not in (0, 1):
        return Checked(kind, number, (("error", "refused", ended.stderr.strip()[-200:]),), seconds)
    findings = json.loads(ended.stdout)["findings"]
    return Checked(kind, number, tuple((f["severity"], f["kind"], f["what"]) for f in findings), seconds)


def share(hits: int, count: int) -> str:
    return f"{hits:5} of {count} ({100 * hits / count:.1f} %)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=700, help="logs, of all classes together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder in which the logs stay")
    given = parser.parse_args()
    each = -(-given.count // len(CLASSES))
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(given.jobs) as pool:
        place = given.keep or Path(scratch)
        cases = [(kind, number) for number in range(each) for kind in CLASSES]
        futures = [pool.submit(checked, k, n, given.seed, place / f"{k}-{n}") for k, n in cases]
        answers = []
        for future in futures:
            answers.append(answer := future.result())
            for severity, kind, what in answer.said:
                if severity != "note" and kind not in MAY_BE_TRUE:
                    print(f"{answer.robot}-{answer.number} {severity} {kind}: {what}", flush=True)
    print(f"\n{'':20}{'logs with an error':>22}{'with a false warning':>26}")
    for robot in (*CLASSES, "all"):
        logs = [answer for answer in answers if robot in ("all", answer.robot)]
        false = [{s for s, kind, _ in log.said if kind not in MAY_BE_TRUE or s == "error"} for log in logs]
        counted = [share(sum(severity in log for log in false), len(logs)) for severity in ("error", "warning")]
        print(f"{robot:20}{counted[0]:>22}{counted[1]:>26}")
    kinds = Counter(pair for answer in answers for pair in {(severity, kind) for severity, kind, _ in answer.said})
    for (severity, kind), hits in sorted(kinds.items(), key=lambda item: -item[1]):
        print(f"{severity:8} {kind:24}{share(hits, len(answers))}{' (may be true)' * (kind in MAY_BE_TRUE)}")
    print(f"a check takes {np.median([answer.seconds for answer in answers]):.1f} s (median)")


if __name__ == "__main__":
    main()
