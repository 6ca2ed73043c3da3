"""The judge: types what a stranger would type, then what omnibench says, and compares with what is right."""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import yaml

from strangers.motion import TURN, Array, Log, counted

ROOT = Path(__file__).resolve().parents[3]
LONGEST = 600  # s, of a command
MOST_FOLLOWED = 2  # commands that check prints and a stranger types; with the two checks before, four in all
_STRAIGHT = 0.3  # rad: runs that turn by less tell lengths
_LACKS, _SPLIT = r"\b(only|no|0|none|never|without|not all|lacks?|alone)\b", r"(train|valid)"
_WARNS_OF_SPLIT = rf"{_LACKS}[^.\n]*{_SPLIT}|{_SPLIT}[^.\n]*{_LACKS}"


@dataclass(frozen=True)
class Right:
    """What is right; each number or expression is judged where it is given. Expressions are regular ones.

    says: each is in what check says. silent: kinds that no error or warning has. unsaid: nothing that check says.
    errors: False: no finding is an error. ready: the verdict. mends: what was typed can be calibrated.
    refusal: of the source, in such words, is as right as all else.
    tolerance: of lengths and turns by the calibration, as shares of the true ones. turned, mirrored: the robot's frame
    may be turned by a constant angle, or be seen from below. export, or radii and separation (m): the exported numbers
    of a differential drive. clean: at most 1.1 times the error of the clean log's calibration, on the clean log.
    evaluated: at most these means of ``evaluate``, m and rad. period: s, of a sample. steering: scale, zero (rad) and
    lag (s) that were typed. split_by: group 1 is the motion in a run's name, and no split lacks one in silence.
    """

    says: Sequence[str] = ()
    silent: str = ""
    unsaid: str = ""
    errors: bool = True
    ready: bool | None = None
    mends: bool = True
    refusal: str = ""
    tolerance: float = 0.015
    turned: bool = False
    mirrored: bool = False
    export: bool = False
    radii: Sequence[float] = ()
    separation: float = 0.0
    clean: bool = False
    evaluated: Sequence[float] = ()
    period: float = 0.0
    steering: Sequence[float] = ()
    split_by: str = ""


@dataclass(frozen=True)
class Variant:
    """A row of the table: how it is made (see make.py), what is typed, and what is right."""

    kind: int
    name: str
    row: dict[str, Any]
    right: Right


@dataclass
class Answer:
    """What was wrong, and all that was typed and heard."""

    wrong: list[str] = field(default_factory=list)
    typed: list[str] = field(default_factory=list)
    heard: str = ""


def settings(options: Sequence[str]) -> str:
    return "".join(f" --set {shlex.quote(option)}" for option in options)


def proposed(said: str) -> list[str]:
    """The options KEY=VALUE that a message or a line says to type, but those with a NAME still to be filled in."""
    found = re.findall(r"--set ((?:'[^']*'|\"(?:[^\"\\]|\\.)*\"|[^\s'\"])+)", said)
    words = [shlex.split(words)[0].rstrip(".,;:)?") for words in found]
    return [word for word in dict.fromkeys(words) if "=" in word and not re.search(r"[=:,\[] ?[A-Z]+\b", word)]


class Case:
    """One variant in a folder of its own, as it is typed and judged."""

    def __init__(self, variant: Variant, folder: Path, log: Log | None) -> None:
        self.right, self.folder, self.log, self.answer = variant.right, folder, log, Answer()
        self.options: list[str] = list(variant.row.get("options", []))
        self.source, self.importer = variant.row.get("source", "log"), variant.row.get("importer", "csv")
        self.calibrating = variant.row.get("calibrate", "")  # options
        self.dataset = self.calibration = self.said = ""
        self.steering = np.array([1.0, 0.0, 0.0])  # scale, zero (rad) and lag (s) by all that was typed

    def judged(self) -> Answer:
        """Ask check, follow it, and compare."""
        if self._ask():
            if self.right.split_by:
                self._judge_split()
            elif self.right.mends and self._calibrate():
                self._judge_numbers()
        return self.answer

    def _wrong(self, statement: str) -> None:
        self.answer.wrong.append(statement)

    def _refused(self, statement: str) -> None:
        if not (self.right.refusal and re.search(self.right.refusal, statement)):
            self._wrong(statement)

    def _type(self, command: str) -> subprocess.CompletedProcess[str]:
        """Type a line into a shell whose omnibench is this project's."""
        self.answer.typed.append(command)
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1"}
        try:
            ended = subprocess.run(
                command, shell=True, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=LONGEST
            )
        except subprocess.TimeoutExpired:
            ended = subprocess.CompletedProcess(command, 124, "", f"longer than {LONGEST} s")
        if "Traceback" in ended.stderr:
            self._wrong(f"a traceback: {ended.stderr.strip().splitlines()[-1]}")
        self.answer.heard += ended.stderr
        return ended

    def _typed(self, command: str, worst: int = 0) -> str:
        """Type a line, once more with the options that its refusal proposes; as it was right, empty if it was not."""
        ended = self._type(command)
        if ended.returncode > worst and (more := proposed(ended.stderr)):
            command += settings(more)
            ended = self._type(command)
        if ended.returncode > worst:
            self._refused(f"`{command}` ended with {ended.returncode}: {ended.stderr.strip()[-300:]}")
        return "" if ended.returncode > worst else command

    def _json(self, command: str) -> dict[str, Any] | str:
        """The document that a command prints; the last of its complaint where it prints none."""
        ended = self._type(f"{command} --json")
        try:
            return dict(json.loads(ended.stdout)) if ended.returncode in (0, 1) else ended.stderr.strip()[-2000:]
        except ValueError:
            return f"no JSON: {ended.stdout[:100]}"

    def _ask(self) -> bool:
        """Type check and what it prints, as long as it prints something that mends; False where that leads nowhere."""
        followed = refused = 0
        while True:
            at = self.dataset or self.source + settings(self.options)
            document = self._json(f"omnibench check {at}")
            if isinstance(document, str):
                more = [option for option in proposed(document) if option not in self.options]
                if self.dataset or not more or refused == 2:
                    self._refused(f"check refused: {document[-300:]}")
                    return False
                self.options += more
                refused += 1
                continue
            findings = document["findings"]
            told = [" ".join(str(value) for value in finding.values()) for finding in findings]
            first, self.said = not self.said, "\n".join([self.said, *told, str(document.get("command", ""))])
            if first:
                self._judge_findings(document)
            fixes = [str(finding["fix"]) for finding in findings if str(finding.get("fix")).startswith("omnibench ")]
            command = str(document.get("command") or "") if "command" in document else "".join(fixes[-1:])
            if not command.startswith("omnibench ") or document["verdict"] == "ready" or followed == MOST_FOLLOWED:
                break
            if not self._follow(command):
                return False
            followed += 1
            if self.calibration:
                break
        for pattern in self.right.says:
            if not re.search(pattern, self.said, re.IGNORECASE):
                self._wrong(f"not said: {pattern}")
        if self.right.unsaid and re.search(self.right.unsaid, self.said):
            self._wrong(f"said: {self.right.unsaid}")
        if self.right.steering:
            away = np.abs(self.steering - self.right.steering) / [0.05 * self.right.steering[0], 0.01, 0.05]
            if (away > 1).any():
                self._wrong(f"steering scale, zero, lag {self.steering.round(4)}, right {list(self.right.steering)}")
        return True

    def _follow(self, command: str) -> bool:
        """Type a line that check printed, and see what it made."""
        command = self._typed(command, worst=1 if " check " in command else 0)
        if not command:
            return False
        words = shlex.split(command)
        output = next((words[n + 1] for n, word in enumerate(words[:-1]) if word in ("-o", "--output")), "")
        if words[1] == "import":
            # A data set's further options come on top of its first ones.
            there = dict(option.split("=", 1) for option in proposed(command))
            keys = ("steering_scale", "steering_offsets_deg", "steering_lag")
            scale, zero, lag = (np.ravel(yaml.safe_load(there.get(key, "nan")))[0] for key in keys)
            before = self.steering if words[2] == "dataset" else np.array([1.0, 0.0, 0.0])
            scale = 1.0 if np.isnan(float(scale)) else float(scale)
            more = np.nan_to_num([0.0, math.radians(float(zero)), float(lag)])
            self.steering = before * [scale, scale, 1.0] + more
            self.dataset = output
        elif words[1] == "calibrate":
            self.calibration = output
        elif words[1] == "check":
            self.options += [option for option in proposed(command) if option not in self.options]
        return True

    def _import(self, source: str, output: str, options: Sequence[str]) -> bool:
        line = f"omnibench import {self.importer} {source} -o {output} --force{settings(options)}"
        return bool(self._typed(line))

    def _imported(self) -> bool:
        if not self.dataset and self._import(self.source, "ds", self.options):
            self.dataset = "ds"
        return bool(self.dataset)

    def _calibrate(self) -> bool:
        """Import what was not imported yet, and calibrate it."""
        if not self._imported():
            return False
        line = f"omnibench calibrate {self.dataset} -o calibration.yaml --force {self.calibrating}"
        if not self.calibration and self._typed(line):
            self.calibration = "calibration.yaml"
        return bool(self.calibration)

    def _judge_findings(self, document: dict[str, Any]) -> None:
        right, ready = self.right, document["verdict"] == "ready"
        for finding in document["findings"]:
            kind = str(finding.get("kind", ""))
            told = f"{kind} ({finding['severity']}): {finding['what']}"[:160]
            if finding["severity"] == "error" and not right.errors:
                self._wrong(f"false error {told}")
            elif finding["severity"] != "note" and right.silent and re.search(right.silent, kind):
                self._wrong(f"false finding {told}")
        if right.ready not in (None, ready):
            self._wrong("READY" if ready else "not READY")

    def _judge_split(self) -> None:
        """Each split of the data set holds all motions, or a message says that it does not."""
        if not self._imported():
            return
        runs = pl.read_parquet(self.folder / self.dataset / "trajectories.parquet")
        motion = pl.col("trajectory").str.extract(self.right.split_by, 1)
        runs = runs.with_columns(motion.alias("motion")).drop_nulls("motion")
        parts = {split: sorted(set(rows["motion"])) for (split,), rows in runs.group_by("split")}
        warned = re.search(_WARNS_OF_SPLIT, self.said + self.answer.heard, re.IGNORECASE)
        if not warned and (len(parts) < 2 or any(part != sorted(set(runs["motion"])) for part in parts.values())):
            self._wrong(f"the split parts motions in silence: {parts}")
        if "command" in runs.columns and "command_pattern" not in str(self.options):
            shared = runs.drop_nulls("command").group_by("command").agg(pl.col("motion").n_unique())
            if len(shared) and max(shared["motion"]) > 1:
                self._wrong("a command for several motions")

    def _judge_numbers(self) -> None:
        right = self.right
        if right.export or right.radii:
            self._judge_export()
        if right.clean:
            if not self._import("clean", "clean_ds", self.options):
                return
            line = f"omnibench calibrate clean_ds -o clean.yaml --force {self.calibrating}"
            costs = [
                self._evaluated(file, "clean_ds", "cost")
                for file in (self.calibration, self._typed(line) and "clean.yaml")
            ]
            if not costs[0] <= 1.1 * costs[1]:
                self._wrong(f"errs {costs[0] / costs[1]:.3f} times as much as the clean log's calibration")
        elif right.evaluated:
            means = [
                self._evaluated(self.calibration, self.dataset, key) for key in ("position_mean_m", "heading_mean_rad")
            ]
            if not all(mean <= most for mean, most in zip(means, right.evaluated, strict=True)):
                self._wrong(f"evaluate: {means[0]:.4f} m, {means[1]:.4f} rad; right: {list(right.evaluated)}")
        elif self.importer == "csv" and not right.steering:
            self._judge_motion()
        if right.period:
            period = yaml.safe_load((self.folder / self.dataset / "dataset.yaml").read_text())["sample_period"]
            if not abs(period / right.period - 1) < 1e-3:
                self._wrong(f"sample period {period:g} s, right {right.period:g}")

    def _evaluated(self, calibration: str, dataset: str, key: str) -> float:
        document = self._json(f"omnibench evaluate {calibration} {dataset}")
        return math.nan if isinstance(document, str) else float(document["splits"]["all"][key])

    def _judge_export(self) -> None:
        """Radii to 0.6 %; their ratio, and the separation in radii, to 0.4 %."""
        radii, separation = self.right.radii, self.right.separation
        if self.log is not None:
            left, right = counted(self.log.true)
            radii, separation = (left["radius"], right["radius"]), left["y"] - right["y"]
        said = self._type(f"omnibench export {self.calibration} --to ros2_controllers").stdout
        exported = {key: float(value) for key, value in re.findall(r"^ +(\w+): ([-0-9.e]+)", said, re.MULTILINE)}
        try:
            wheels = [
                exported["wheel_radius"] * exported[f"{side}_wheel_radius_multiplier"] for side in ("left", "right")
            ]
            apart = exported["wheel_separation"] * exported["wheel_separation_multiplier"]
        except KeyError:
            self._wrong("nothing exported")
            return
        length, ratio = sum(wheels) / sum(radii), wheels[0] / wheels[1] / (radii[0] / radii[1])
        away = np.abs([length - 1, ratio - 1, apart / separation / length - 1])
        if (away > [0.006, 0.004, 0.004]).any():
            self._wrong(
                f"radii {length:.4f}, left/right {ratio:.4f}, separation {apart / separation:.4f} of the true ones"
            )

    def _judge_motion(self) -> None:
        """Lengths and turns by the calibration, of the wheels in the data set, beside the true motions."""
        dataset = self.folder / self.dataset
        driven, true = motions_by(self.folder / self.calibration, dataset), motions_of_poses(dataset)
        if self.log is not None:
            true = {name: (*run.net, run.way, run.turned) for name, run in self.log.runs.items()}
        runs = [name for name in driven if name in true]
        if not runs:
            self._wrong("no run of the data set is one of the recording")
            return
        (dx, dy, turn), (x, y, heading, way, turned) = (
            np.array([driven[n] for n in runs]).T,
            np.array([true[n] for n in runs]).T,
        )
        verdicts = []
        for side in (1, -1) if self.right.mirrored else (1,):
            place, mark = dx + 1j * dy, x + 1j * side * y
            place = place * np.exp(1j * np.angle(np.vdot(place, mark))) if self.right.turned else place
            away = np.median(np.abs(place - mark) / (way + 0.2 * turned + 0.1))
            far = (turned < _STRAIGHT) & (np.abs(mark) > 0.5)
            length = np.abs(place[far]) @ np.abs(mark[far]) / (np.abs(mark[far]) ** 2).sum() if far.any() else 1.0
            turns = turn @ heading * side / (heading @ heading) if turned.max() > _STRAIGHT else 1.0
            verdicts.append((max(abs(length - 1), abs(turns - 1), away / 2), length, turns, away))
        worst, length, turns, away = min(verdicts)
        if not worst <= self.right.tolerance:
            self._wrong(
                f"lengths {length:.4f}, turns {turns:.4f} of the true ones, ends {100 * away:.1f} % of the way off"
            )


def _rows(dataset: Path, table: str) -> dict[str, pl.DataFrame]:
    rows = pl.read_parquet(dataset / f"{table}.parquet")
    return {str(name): part for (name,), part in rows.group_by("trajectory", maintain_order=True)}


def motions_of_poses(dataset: Path) -> dict[str, tuple[float, ...]]:
    """Net motion (x, y, turn), way and turned angle of each run by the data set's own poses."""
    motions: dict[str, tuple[float, ...]] = {}
    for name, rows in _rows(dataset, "poses").items() if (dataset / "poses.parquet").is_file() else ():
        x, y, heading = rows.select("x", "y", "theta").to_numpy().T
        steps, turn = np.diff(x + 1j * y), float(np.diff(np.unwrap(heading)).sum())
        net = steps.sum() * np.exp(-1j * heading[0])
        motions[name] = (float(net.real), float(net.imag), turn, float(np.abs(steps).sum()), abs(turn))
    return motions


def motions_by(calibration: Path, dataset: Path) -> dict[str, Array]:
    """Net motion (x, y, turn) of each run by a calibration's matrix over the data set's wheels, in arcs."""
    content, header = (yaml.safe_load(file.read_text()) for file in (calibration, dataset / "dataset.yaml"))
    matrix, wheels = np.array(content["matrix"]), header["wheels"]
    steered = [wheel["name"] for wheel in header["robot"]["wheels"] if wheel.get("type") == "steered"]
    motions = {}
    for name, rows in _rows(dataset, "wheels").items():
        times = np.append(0.0, rows["t"].to_numpy())
        signals = rows.select([f"omega_{wheel}" for wheel in wheels]).to_numpy()
        if steered:
            angles = rows.select([f"steer_{wheel}" for wheel in steered]).to_numpy()
            angles = (angles + np.vstack([angles[:1], angles[:-1]])) / 2
            mean, apart = signals.mean(axis=1, keepdims=True), np.diff(signals, axis=1)
            if steered == wheels:  # each driven wheel is steered; else fixed ones follow one that is
                signals = np.stack([signals * np.cos(angles), signals * np.sin(angles)], axis=2).reshape(len(rows), -1)
            else:
                signals = np.hstack([mean, mean * np.tan(angles), apart])
        steps = signals[:, : matrix.shape[1]] @ matrix.T * np.diff(times)[:, None]
        heading = np.append(0.0, np.cumsum(steps[:, 2]))
        chords = (steps[:, 0] + 1j * steps[:, 1]) * np.sinc(steps[:, 2] / TURN)
        net = (chords * np.exp(1j * (heading[:-1] + steps[:, 2] / 2))).sum()
        motions[name] = np.array([net.real, net.imag, heading[-1]])
    return motions
