"""Study of the constants of ``omnibench discover``: what would change if each were half or twice as large.

    python tests/studies/constants.py --out constants.jsonl [--only evidence] [--table]

Every number that a module of omnibench.discover names in capitals is varied by itself, over a dozen small blind sets.
Of a share above one half, the rest to 1 is varied. One line of JSON a set and constant, added as it comes: run
again with the same file, and it goes on where it was. Sets are made as for discover_study.py.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hidden.sets import Kind, make_set
from named_constants import Constant, constants_of, modules_of
from results_file import ResultsFile

from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.result import Discovery
from omnibench.processes import one_thread

PACKAGE = "omnibench.discover"
RUNS = "omnibench.fit.trajectory_fit"  # what discover begins with
FACTORS = (0.5, 2.0)
SURE = 0.95  # weight from which on a name is stated with confidence: the verdict "named" in the design
# What is the same whatever the constants after the screening are, and what none of those before the end can change.
FRONT = ("usable_runs", "fit_matrix", "make_groups", "screen", "extend", "without_effects")
TAIL = ("validation_runs", "compare_held_out", "waterfall_steps", "extrapolations_of", "calibration_of_fit")
OF_FRONT = ("fit", "covariates", "paths", "screening", RUNS)
OF_TAIL = ("held_out", "conclude")


class Set(Model):
    """A small set: what is hidden in it, and what the discovery is asked for."""

    kind: Kind
    effects: tuple[str, ...] = ()
    level: float = 400.0
    seed: int = 1000
    noise: str = "plain"
    without: tuple[str, ...] = ()
    unknown_term: bool = False

    @property
    def name(self) -> str:
        return " ".join(
            [self.kind, "+".join(self.effects) or self.noise, *(f"without {name}" for name in self.without)]
        )


SETS = (
    Set(kind="single", effects=("heading_drift",), level=150.0),
    Set(kind="pair", effects=("thermal_radius_drift", "wheel_eccentricity")),
    Set(kind="outside", effects=("wet_patch",), unknown_term=True),
    Set(kind="single", effects=("floor_drift",), without=("floor_drift",)),
    Set(kind="null"),
    Set(kind="actuator", effects=("motor_lag",)),
    Set(kind="pair", effects=("heading_drift", "floor_drift")),
    Set(kind="single", effects=("speed_dependent_radius",)),
    Set(kind="null", noise="outliers"),
    Set(kind="outside", effects=("oval_wheel",), unknown_term=True),
    Set(kind="single", effects=("reference_time_offset",), level=150.0),
    Set(kind="single", effects=("wheel_eccentricity",)),
)


class Answer(Model):
    """The parts of a discovery that words are made of. names: with those that they are confusable with."""

    verdict: str
    names: tuple[tuple[str, ...], ...]
    sure: tuple[str, ...]
    where: tuple[str, ...]
    classes: tuple[tuple[str, ...], ...]
    absorbed: tuple[str, ...]
    steps: tuple[str, ...]
    closed: tuple[bool, ...]
    extrapolations: tuple[str, ...]

    @staticmethod
    def of(discovery: Discovery) -> Answer:
        return Answer(
            verdict=discovery.verdict,
            names=tuple((effect.name, *sorted(effect.confusable_with)) for effect in discovery.effects),
            sure=tuple(effect.name for effect in discovery.effects if effect.weight >= SURE),
            where=tuple(each.covariate for each in discovery.where[:2]),
            classes=discovery.classes,
            absorbed=discovery.absorbed,
            steps=tuple(step.name for step in discovery.steps),
            closed=tuple(gap.closed is not None for held in discovery.held_out for gap in (held.eq6, held.chi2)),
            extrapolations=tuple(each.command for each in discovery.extrapolations),
        )

    @property
    def of_names(self) -> object:
        """Verdict and names, without what they are confusable with."""
        return self.verdict, tuple(sorted(group[0] for group in self.names)), self.sure


class Result(Model):
    """The answer on one set with one constant at another value. constant: "" for the answer as it is."""

    set: str
    constant: str
    factor: float
    value: str
    answer: Answer | None
    failure: str = ""

    @property
    def key(self) -> tuple[str, str, float]:
        return self.set, self.constant, self.factor


def constants() -> list[Constant]:
    """All numbers in capitals of omnibench.discover, without its report: there they shape drawings only."""
    return constants_of(PACKAGE, (f"{PACKAGE}.report",)) + constants_of(RUNS)


class Memory:
    """Results of the slow steps of a discovery, so that a step whose arguments did not change is not done again."""

    def __init__(self) -> None:
        self._known: dict[object, tuple[object, object]] = {}

    @contextmanager
    def of(self, names: Sequence[str]) -> Iterator[None]:
        """Let the functions of these names remember, wherever a module of discover uses them."""
        with ExitStack() as stack:
            for module in modules_of(PACKAGE, (f"{PACKAGE}.report",)):
                for name in names:
                    if callable(function := getattr(module, name, None)):
                        setattr(module, name, self._remembering(name, function))
                        stack.callback(setattr, module, name, function)
            yield

    def _remembering(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def remembering(*arguments: Any) -> Any:
            key = (name, *map(_key, arguments))
            if key not in self._known:
                self._known[key] = (function(*arguments), arguments)  # what is held keeps its identity
            return self._known[key][0]

        return remembering


def _key(argument: Any) -> object:
    if isinstance(argument, list | tuple):
        return tuple(map(_key, argument))
    if hasattr(argument, "shapes"):  # a group of columns: made anew with each screening
        return argument.name, tuple(argument.shapes.items()), tuple(each.name for each in argument.parameters)
    if isinstance(argument, np.ndarray):
        return argument.tobytes()
    return argument if isinstance(argument, str | float | int) else id(argument)


def study(one: Set, varied: Sequence[Constant], done: set[tuple[str, str, float]]) -> Iterator[Result]:
    """The answers on one set: as it is, then with each constant varied, if they are not known already."""
    wanted = [(each, factor) for each in varied for factor in FACTORS if (one.name, each.title, factor) not in done]
    if not wanted:
        return
    with one_thread():
        dataset, _ = make_set(one.kind, one.effects, one.level, one.seed, design="small", noise=one.noise)
        if one.kind != "actuator":  # without targets nothing is asked of the motors, which takes its time
            dataset = replace(dataset, trajectories=tuple(replace(run, targets=None) for run in dataset.trajectories))
        memory = Memory()
        if (one.name, "", 1.0) not in done:
            yield _answered(one, dataset, "", 1.0, "", memory, (*FRONT, *TAIL))
        for constant, factor in wanted:
            title, value = constant.title, str(constant.times(factor))
            front = title.startswith(OF_FRONT)
            with constant.varied(factor):
                remembered = () if front else FRONT if title.startswith(OF_TAIL) else (*FRONT, *TAIL)
                yield _answered(one, dataset, title, factor, value, memory, remembered)


def _answered(
    one: Set, dataset: Dataset, constant: str, factor: float, value: str, memory: Memory, remembered: Sequence[str]
) -> Result:
    answer, failure = None, ""
    try:
        with memory.of(remembered):
            discovery = discover_effects(dataset, without=one.without, unknown_term=one.unknown_term, seed=one.seed)
        answer = Answer.of(discovery)
    except Exception as error:  # the study goes on, and the table says so
        failure = f"{type(error).__name__}: {error}"
    return Result(set=one.name, constant=constant, factor=factor, value=value, answer=answer, failure=failure)


def print_table(results: Sequence[Result]) -> None:
    """One line a constant: its value, and the sets whose verdict or names change; then what else changes."""
    usual = {each.set: each.answer for each in results if not each.constant}
    known = {each.title: each.value for each in constants()}
    for title in dict.fromkeys(each.constant for each in results if each.constant):
        of_constant = [each for each in results if each.constant == title]
        print(f"{title:52} {known.get(title, 'gone')!s:>8}  sets {len(of_constant) // len(FACTORS)}")
        for each in of_constant:
            for words in _changes(each, usual[each.set]):
                print(f"    at {each.value:>8}, {each.set}: {words}")


def _changes(result: Result, usual: Answer | None) -> Iterator[str]:
    if result.answer is None or usual is None:
        yield result.failure or "no answer as it is"
        return
    if result.answer.of_names != usual.of_names:
        yield f"VERDICT {_words(usual)} -> {_words(result.answer)}"
    before, after = (answer.model_dump(exclude={"verdict", "sure", "steps"}) for answer in (usual, result.answer))
    changed = [name for name, value in before.items() if after[name] != value]
    if changed:
        yield f"changes in {', '.join(changed)}"


def _words(answer: Answer) -> str:
    names = ", ".join(name + ("*" if name in answer.sure else "") for name, *_ in answer.names)
    return f"{answer.verdict} ({names})"


def main() -> None:
    """Carry out what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of answers, one line of JSON each")
    parser.add_argument("--only", action="append", default=[], metavar="PART", help="of a constant's name")
    parser.add_argument("--sets", type=int, default=len(SETS), help="how many sets, the first ones")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    arguments = parser.parse_args()
    file = ResultsFile(arguments.out, Result)
    if not arguments.table:
        varied = [each for each in constants() if not arguments.only or any(p in each.title for p in arguments.only)]
        for one in SETS[: arguments.sets]:
            for result in study(one, varied, {each.key for each in file.results}):
                file.add(result)
    print_table(file.results)


if __name__ == "__main__":
    main()
