"""Studies of constants: what changes if each number that modules name in capitals is half or twice as large.

Shared by constants_fit.py and constants_slam.py. Every number is varied by itself, and a line of JSON added for each as
it comes: run again with the same file, a study goes on where it was. The table says of each

- estimates: largest change of an estimate (matrix, pose, choice of a design), in its standard deviations,
- stated: largest change of a stated standard deviation, as a share of it,
- words: whether outcomes, warnings or verdicts change,
- work: largest change of the work (parts of a box, evaluations), as a share of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from named_constants import Constant, constants_of
from results_file import ResultsFile

from omnibench.config import Model
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Array

FACTORS = (0.5, 2.0)
# Kinds of figures whose medians are printed, and their units.
FIGURES = {"error": " mm", "nees": "", "covered": " %", "lines": "", "straight": ""}


class Value(Model):
    """A figure of an answer.

    kind: one of those above or of FIGURES. scale: the unit of its change; 0 where only equality counts.
    """

    kind: str
    values: tuple[float, ...] = ()
    scale: tuple[float, ...] = ()
    words: str = ""

    def change(self, other: Value) -> float:
        """How far another value is from this one: a multiple of the scale, or 1 for other words."""
        if self.kind == "words":
            return float(self.words != other.words)
        if len(self.values) != len(other.values):
            return np.inf
        apart, scale = np.abs(np.subtract(self.values, other.values)), np.array(self.scale)
        return float(np.max(apart[scale > 0] / scale[scale > 0], initial=0.0))


Answer = dict[str, Value]


class Result(Model):
    """The answers with one constant at another value; constant "" for those as they are."""

    part: str
    constant: str
    factor: float
    value: str
    answer: dict[str, Value]
    failure: str = ""


def estimates(values: Array, deviations: Array) -> Value:
    return Value(kind="estimates", values=tuple(np.ravel(values)), scale=tuple(np.ravel(deviations)))


def stated(deviations: Array) -> Value:
    return Value(kind="stated", values=tuple(np.ravel(deviations)), scale=tuple(np.ravel(deviations)))


def work(*amounts: float) -> Value:
    return Value(kind="work", values=amounts, scale=amounts)


def words(*texts: object) -> Value:
    return Value(kind="words", words=" | ".join(map(str, texts)))


@dataclass(frozen=True)
class Part:
    """A part of a study: the package or module whose constants it varies, and the answers that may change.

    elsewhere: modules that are left out, by the beginnings of their names.
    """

    package: str
    answers: Callable[[], Answer]
    elsewhere: tuple[str, ...] = ()


def study(name: str, part: Part, only: Sequence[str], done: set[tuple[str, str, float]]) -> Iterator[Result]:
    """The answers of a part as they are, then with each constant varied, if they are not known already."""
    varied = [each for each in constants_of(part.package, part.elsewhere) if _is_wanted(each, only)]
    wanted = [(each, factor) for each in varied for factor in FACTORS if (name, each.title, factor) not in done]
    with one_thread():
        if (name, "", 1.0) not in done:
            yield Result(part=name, constant="", factor=1.0, value="", answer=part.answers())
        for constant, factor in wanted:
            answer, failure = {}, ""
            with constant.varied(factor):
                try:
                    answer = part.answers()
                except Exception as error:  # the study goes on, and the table says so
                    failure = f"{type(error).__name__}: {error}"
            value = str(constant.times(factor)).replace("\n", "")
            yield Result(part=name, constant=constant.title, factor=factor, value=value, answer=answer, failure=failure)


def _is_wanted(constant: Constant, only: Sequence[str]) -> bool:
    return not only or any(part in constant.title for part in only)


def print_table(results: Sequence[Result]) -> None:
    """A line for each constant and factor: the largest change of each kind, and where."""
    usual = {each.part: each.answer for each in results if not each.constant}
    for part, answer in usual.items():
        for kind, unit in FIGURES.items():
            figures = [value.values[0] for value in answer.values() if value.kind == kind]
            if figures:
                print(f"{part}: median {kind} {np.median(figures):.3f}{unit}")
    for result in results:
        if result.constant:
            print(f"{result.part} {result.constant:45} {result.value:>12}  {_changes(result, usual[result.part])}")


def _changes(result: Result, usual: Answer) -> str:
    if result.failure:
        return result.failure
    texts = []
    for kind in ("estimates", "stated", "words", "work"):
        changes = {name: value.change(result.answer[name]) for name, value in usual.items() if value.kind == kind}
        worst = max(changes, key=lambda name: changes[name], default="")
        if worst and changes[worst] > 1e-6:
            texts.append(f"{kind} {changes[worst]:.2g} ({worst})" if kind != "words" else f"words ({worst})")
    for kind in FIGURES:
        figures = [
            [answer[name].values[0] for name, value in usual.items() if value.kind == kind]
            for answer in (usual, result.answer)
        ]
        if figures[0] and figures[0] != figures[1]:
            texts.append(f"{kind} {np.median(figures[0]):.3f} -> {np.median(figures[1]):.3f}")
    return "; ".join(texts) or "nothing"


def carry_out(parts: Mapping[str, Part], description: str | None) -> None:
    """A study's command line: carry out what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of answers, one line of JSON each")
    parser.add_argument("--part", nargs="+", choices=tuple(parts), default=tuple(parts))
    parser.add_argument("--only", action="append", default=[], metavar="PART", help="of a constant's name")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    arguments = parser.parse_args()
    file = ResultsFile(arguments.out, Result)
    if not arguments.table:
        done = {(each.part, each.constant, each.factor) for each in file.results}
        for name in arguments.part:
            for result in study(name, parts[name], arguments.only, done):
                file.add(result)
    print_table([each for each in file.results if each.part in arguments.part])
