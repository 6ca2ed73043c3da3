"""Study of sessions that differ: how often it is said of those that do, and of those that do not.

    python tests/studies/session_study.py [--sets 50] [--out sessions.jsonl] [--only TEXT]      # half an hour

The sets are made without the code that compares sessions (tests/studies/hidden): the true wheels of the validation
session are larger by a share of their radius, all of them or one. Four times as many sets of sessions that do not
differ are made, in turn with each kind of noise, and others with an effect in all sessions alike, which the model of
discover holds or nothing holds. One line of JSON a set, added as it comes: run again with the same file, and it goes on
where it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from hidden.disturbances import NULL_KINDS
from hidden.session_sets import session_set
from results_file import ResultsFile

from omnibench.data.dataset import Dataset
from omnibench.discover.fit import extend, fit_matrix
from omnibench.discover.significance import Group
from omnibench.fit.sessions import SessionComparison, compare_sessions
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.processes import one_thread
from omnibench.registry import effects
from omnibench.robot.model import OdometryModel

EFFECTS = ("rotation_translation_coupling", "heading_drift", "floor_drift", "wheel_dead_zone")
CHANGES = (0.005, 0.01, 0.02)
DESIGNS = ("flower", "small", "sessions")  # 36 commands, 12 commands, 36 commands in three sessions to train


@dataclass(frozen=True)
class Case:
    """One row of the table.

    held: True if the model holds the effect. validation: a design of other commands. single: one run is all that the
    validation session has.
    """

    name: str
    times: int = 1
    designs: tuple[str, ...] = DESIGNS
    change: float = 0.0
    wheels: tuple[str, ...] = ("a", "b", "c")
    effects: tuple[str, ...] = ("",)
    held: bool = False
    noises: tuple[str, ...] = ("plain",)
    repetitions: int = 5
    validation: str = ""
    single: bool = False


@dataclass(frozen=True)
class Answer:
    """The answer on one set. said: a session was said to differ, other: that other commands are driven and deviate.

    right: the change's kind is the true one. covered: its interval holds the truth, None without one.
    """

    case: str
    seed: int
    said: bool
    other: bool
    right: bool
    covered: bool | None


def cases() -> Iterator[Case]:
    """All rows."""
    for change in CHANGES:
        yield Case(f"{100 * change:g} % of all radii", change=change)
        yield Case(f"{100 * change:g} % of one radius", change=change, wheels=("b",))
    for change in CHANGES:
        yield Case(f"two repetitions of 12, {100 * change:g} % of all", 1, ("small",), change, repetitions=2)
    yield Case("nothing differs", 4, noises=NULL_KINDS)
    yield Case("nothing differs, two repetitions of 12", 4, ("small",), repetitions=2, noises=NULL_KINDS)
    yield Case("nothing differs, a single run to validate", 8, noises=NULL_KINDS, single=True)
    for change in (0.02, 0.05):
        yield Case(f"a single run, {100 * change:g} % of all", change=change, single=True)
    yield Case("effect alike, in the model", 2, ("flower",), effects=EFFECTS, held=True)
    yield Case("effect alike, not in the model", 2, effects=EFFECTS)
    yield Case("effect in the model, 1 % of all radii", 1, ("flower",), 0.01, effects=EFFECTS, held=True)
    yield Case("effect not in the model, 1 % of all radii", 1, DESIGNS, 0.01, effects=EFFECTS)
    yield Case("other commands, effect not in the model", 1, ("flower",), effects=EFFECTS, validation="rich")
    yield Case("other commands, nothing else", 2, ("flower",), validation="rich")
    yield Case("other commands, 2 % of all radii", 1, ("flower",), 0.02, validation="rich")


def answer(case: Case, seed: int) -> Answer:
    """Make a set and compare its sessions."""
    effect = case.effects[seed % len(case.effects)]
    dataset = session_set(
        case.designs[seed % len(case.designs)],
        seed,
        change=case.change,
        wheels=case.wheels,
        effect=effect,
        noise=case.noises[seed % len(case.noises)],
        repetitions=case.repetitions,
        validation=case.validation,
    )
    if case.single:
        held_out = dataset.split("validation")
        runs = (*dataset.split("train"), held_out[seed % len(held_out)])
        dataset = replace(dataset, trajectories=runs)
    found = _with_effect(dataset, effect) if case.held else _by_design(dataset)
    changed = [each for each in found.differences if each.session == dataset.trajectories[-1].session]
    kind = "all wheels" if len(case.wheels) > 1 else "one wheel"
    right = bool(changed) and changed[0].kind == kind
    covered = None
    if right:
        covered = changed[0].radii[0].low < case.change < changed[0].radii[0].high
    return Answer(case.name, seed, bool(found.differences), found.other_commands is not None, right, covered)


def _by_design(dataset: Dataset) -> SessionComparison:
    """By the design's matrix, as evaluate compares them."""
    model = OdometryModel(dataset.robot, dataset.robot.inverse_kinematic_matrix, "arc", (), dataset.sample_period)
    return compare_sessions(model, dataset.trajectories)


def _with_effect(dataset: Dataset, name: str) -> SessionComparison:
    """By matrix and effect fitted to the training runs, as discover compares them."""
    runs = usable_runs(dataset.split("train"))
    plain = fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)
    effect = effects.create(name)
    linear = tuple(each for each in effect.parameters(dataset.robot) if not each.choices)
    fit = extend(plain, [Group("effect", name, (), effect, linear)]).fit
    held_out = usable_runs(dataset.split("validation"), "validation")
    return compare_sessions(fit.model, [*runs, *held_out])


def carried_out(wanted: Sequence[Case], sets: int, path: Path | None) -> list[Answer]:
    """The answers on all sets; those of the file are not sought again."""
    file = ResultsFile(path, Answer)
    done = {(each.case, each.seed) for each in file.results}
    for case in wanted:
        for seed in range(sets * case.times):
            if (case.name, seed) not in done:
                file.add(answer(case, seed))
    return file.results


def print_table(answers: Sequence[Answer]) -> None:
    """How often it is said, that the kind is right, that its interval holds the truth, that other commands deviate."""
    print(f"{'':46}{'sets':>5}{'said':>9}{'kind':>9}{'interval':>10}{'commands':>10}")
    for case in dict.fromkeys(each.case for each in answers):
        of_case = [each for each in answers if each.case == case]
        known = [each.covered for each in of_case if each.covered is not None]
        shares = [np.mean([each.said for each in of_case]), np.mean([each.right for each in of_case])]
        words = [f"{100 * share:.1f} %" for share in shares]
        words.append(f"{100 * np.mean(known):.1f} %" if known else "-")
        words.append(f"{100 * np.mean([each.other for each in of_case]):.1f} %")
        print(f"{case:46}{len(of_case):5}{words[0]:>9}{words[1]:>9}{words[2]:>10}{words[3]:>10}", flush=True)


def main() -> None:
    """Make the sets that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=50)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--only", default="", help="text that the names of rows must hold")
    arguments = parser.parse_args()
    one_thread()
    print_table(carried_out([case for case in cases() if arguments.only in case.name], arguments.sets, arguments.out))


if __name__ == "__main__":
    main()
