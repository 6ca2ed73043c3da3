"""One case of the exam: files written, `omnibench check` and its fix typed into a shell, and the result."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from check_exam.faults import MAKERS, Damage
from check_exam.judging import Finding, false_findings, known_kinds, right_kinds, table, unsound
from check_exam.recordings import Recording, recording
from check_exam.shell import typed
from check_exam.writing import Source, read_dataset, write

_WORDS = re.compile(
    r"\b(drive|record|repeat|turn|log|track|measure|check|leave|look|name|connect|another)", re.IGNORECASE
)
_OPTION = re.compile(r"[a-z_]+=")
_FEWEST, _MOST = 8, 14  # runs of a case
UNTOUCHED = "untouched"


@dataclass
class Result:
    """A case and how it went. fixed: None where nothing was to be typed."""

    robot: str
    kind: str
    seed: int
    form: str = ""
    detail: str = ""
    command: str = ""
    found: bool = False
    fixed: bool | None = None
    reason: str = ""
    fix: str = ""
    line: str = ""
    verdict: str = ""
    findings: list[dict[str, str]] = field(default_factory=list)
    beside: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        return self.found and self.fixed is not False


def generator(robot: str, kind: str, seed: int) -> Generator:
    """Numbers of one case, whatever other cases there are."""
    return np.random.default_rng([seed, *f"{robot} {kind}".encode()])


def chosen_runs(robot: str, kind: str, rng: Generator) -> Recording:
    """Some of a robot's runs: by whole commands, so that repetitions stay together."""
    whole = recording(robot)
    if kind in ("few_repetitions", "motion_missing", "few_runs") or len(whole.runs) <= _FEWEST:
        return whole
    commands = sorted({run.command for run in whole.runs})
    rng.shuffle(commands)
    names: set[str] = set()
    for command in commands:
        of_command = [run.name for run in whole.runs if run.command == command]
        names |= set(rng.permutation(of_command)[:5].tolist())
        if len(names) >= _FEWEST and len({run.command for run in whole.runs if run.name in names}) >= 3:
            break
    kept = sorted(names)[:_MOST]
    return whole.of([run for run in whole.runs if run.name in kept])


def sit(robot: str, kind: str, seed: int, scratch: Path) -> Result:
    """A fault of a kind on a robot: is it found, and does the fix work?"""
    begin = time.monotonic()
    rng = generator(robot, kind, seed)
    damage = MAKERS[kind](chosen_runs(robot, kind, rng), rng)
    form = str(rng.choice(damage.forms))
    folder = scratch / f"{robot}-{kind}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    source = write(damage, form, folder)
    result = Result(robot, kind, seed, form, damage.detail)
    _judge(result, damage, source)
    if result.passed:
        shutil.rmtree(folder)
    result.seconds = round(time.monotonic() - begin, 1)
    return result


def sit_untouched(name: str, untouched: Recording, seed: int, scratch: Path) -> Result:
    """A recording without a fault, or a part of one: what is found that is not true?"""
    begin = time.monotonic()
    rng = generator(untouched.robot, name, seed)
    damage = Damage(untouched, untouched, name)
    form = str(rng.choice(damage.forms))
    folder = scratch / f"{untouched.robot}-{UNTOUCHED}-{seed}-{name.replace(' ', '_')}"
    shutil.rmtree(folder, ignore_errors=True)
    source = write(damage, form, folder)
    result = Result(untouched.robot, UNTOUCHED, seed, form, name)
    findings = _checked(result, source.name, source.options, folder)
    if findings is not None:
        wrong = false_findings(findings, untouched)
        result.found = not wrong
        result.beside = [finding.kind for finding in wrong]
        result.reason = "; ".join(f"{finding.kind} ({finding.severity}): {finding.what}" for finding in wrong)
    shutil.rmtree(folder)
    result.seconds = round(time.monotonic() - begin, 1)
    return result


def _checked(result: Result, source: str, options: tuple[str, ...], folder: Path) -> list[Finding] | None:
    """The findings of `omnibench check`; None, with the reason in the result, where it says none."""
    command = shlex.join(["omnibench", "check", source, *options, "--json"])
    result.command = result.command or command
    answer = typed(command, folder)
    content: Any = None
    if answer.status in (0, 1):  # ready; fix, or record more
        try:
            content = json.loads(answer.output)
        except json.JSONDecodeError:
            result.reason = f"no JSON on standard output: {answer.output[:200]!r}"
            return None
    if not isinstance(content, dict):
        result.reason = f"{command} ended with {answer.status}: {answer.errors.strip()[-400:]}"
        return None
    findings = [Finding.of(each) for each in content["findings"]]
    result.line = str(content["command"])
    if not result.findings and not result.verdict:
        result.verdict = str(content["verdict"])
        result.findings = [asdict(finding) for finding in findings]
    return findings


def _judge(result: Result, damage: Damage, source: Source) -> None:
    robot, kind = result.robot, result.kind
    right, way = right_kinds(kind, robot), table()["kinds"][kind]["fix"]
    findings = _checked(result, source.name, source.options, source.folder)
    if findings is None:
        return
    result.beside = sorted({each.kind for each in findings} - right - known_kinds(robot))
    candidates = sorted((each for each in findings if each.kind in right), key=lambda each: each.kind != kind)
    naming = [each for each in candidates if each.names(damage.named)]
    if not naming and not (candidates and all(any(name in f"{c}" for c in candidates) for name in damage.named)):
        result.reason = f"not found; said {', '.join(each.kind for each in findings) or 'nothing'}"
        if candidates:
            result.reason = (
                f"found, but {', '.join(damage.named)} not named: {candidates[0].where}: {candidates[0].what}"
            )
        return
    result.found = True
    finding = (naming or candidates)[0]
    result.fix = finding.fix
    if way == "none":
        result.fixed = _imports(result, damage, source)
    elif _OPTION.match(finding.fix):
        result.fixed = _works(result, damage, source, _typed(result.line, finding.fix, source), right)
    elif way == "typed":
        result.fixed, result.reason = False, f"the fix cannot be typed: {finding.fix!r}"
    else:
        result.fixed = bool(_WORDS.search(finding.fix))
        result.reason = "" if result.fixed else f"the fix does not say what to do: {finding.fix!r}"


def _imports(result: Result, damage: Damage, source: Source) -> bool:
    """True if the source is imported as it is, and is sound."""
    options = [
        word.replace("robot.yaml", "robot=robot.yaml") if word == "robot.yaml" else word for word in source.options
    ]
    options = ["--set" if word == "--robot" else word for word in options]
    command = shlex.join(["omnibench", "import", "csv", source.name, "-o", "mended", *options])
    return _sound_import(result, damage, source, command) is not None


def _typed(line: str, fix: str, source: Source) -> str:
    """The line to type for a fix: the one of all fixes, or the import with this one, which is no error's."""
    if fix.partition(" --set ")[0].partition("=")[0] in line:
        return line
    if source.name == "csv" or not line:
        words = ["--set" if word == "--robot" else word for word in source.options]
        words = [f"robot={word}" if word == "robot.yaml" else word for word in words]
        options = [option for each in fix.split(" --set ") for option in ("--set", each)]
        form = "dataset" if (source.folder / source.name / "dataset.yaml").is_file() else "csv"
        return shlex.join(["omnibench", "import", form, source.name, "-o", "mended", *words, *options])
    return f"{line} --set {shlex.quote(fix)}"


def _works(result: Result, damage: Damage, source: Source, fix: str, right: set[str]) -> bool:
    """True if a fix, typed as given, makes a sound data set that is no longer found fault with."""
    way = table()["kinds"][result.kind]["fix"]
    if way == "words" or not re.match(r"omnibench (import|slam)", fix):
        answer = typed(fix, source.folder)
        if answer.status:
            result.reason = f"the fix ended with {answer.status}: {answer.errors.strip()[-300:]}"
        return answer.status == 0
    made = _sound_import(result, damage, source, fix)
    if made is None:
        return False
    again = _checked(replace(result, reason=""), made.name, (), made.parent)
    if again is None:
        result.reason = "the mended data set cannot be checked"
        return False
    left = {each.kind for each in again if each.severity != "note"} & right - known_kinds(result.robot)
    if left:
        result.reason = f"still found after the fix: {', '.join(sorted(left))}"
    return not left


def _sound_import(result: Result, damage: Damage, source: Source, command: str) -> Path | None:
    """The data set that a command wrote; None, with the reason in the result, if it is not sound."""
    answer = typed(command, source.folder)
    if answer.status:
        result.reason = f"the fix ended with {answer.status}: {answer.errors.strip()[-300:]}"
        return None
    written = re.search(r"(?:-o|--output)[= ]+(\S+)", command)
    folder = source.folder / (shlex.split(written[1])[0] if written else "")
    if not (folder / "dataset.yaml").is_file():
        result.reason = f"no data set at {folder.name} after the fix"
        return None
    result.reason = unsound(result.kind, damage, read_dataset(folder, damage.sound))
    return None if result.reason else folder
