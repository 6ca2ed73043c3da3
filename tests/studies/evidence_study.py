"""Study of what right and wrong names leave: the numbers in omnibench.discover.select.

    python tests/studies/evidence_study.py --out evidence.jsonl [--seeds 2] [--table]

Blind sets with one strong effect, with two, and with one that no catalogue has, as for discover_study.py; and with one
effect whose form is distorted further. Right names are taken for granted and fitted. Measured are the share of the
non-centrality that other forms of them explain, and that generic bases then still find; how much other effects gain
beyond chance, which is what the discrepancy of the catalogue's forms makes; how far effects cancel each other; and how
often they are said to imitate something else. The same is measured of the best wrong names: those that explain most
where the right ones are left out. One line of JSON a set, added as it comes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Literal

import numpy as np
from hidden.forms import FORMS
from hidden.outside import OUTSIDE
from hidden.pairs import PAIRS
from hidden.sets import LEVELS, FormName, Kind, make_set
from results_file import ResultsFile

from omnibench.config import Model
from omnibench.discover.fit import extend, fit_matrix
from omnibench.discover.result import SURE
from omnibench.discover.screening import Screening, make_groups, screen
from omnibench.discover.select import credibility_of, effect_sets, indices_of, joint_share
from omnibench.discover.significance import Group, significance_of
from omnibench.fit.trajectory_fit import Given, usable_runs
from omnibench.processes import one_thread

FIRST_SEED = 1000  # those below are the exam of discover_study.py
UNDISTORTED = ("tyre_wear", "reference_time_offset", "heading_latency")  # they have no size that could vary
Hidden = Literal[Kind, "distorted"]


class Names(Model):
    """Names that explain a set. right: they are those that are hidden.

    energy: non-centrality that they explain. off_form, left: as in Credibility. joint: chi-square together over what
    each makes alone. probability, imitation: as stated.
    """

    right: bool
    names: tuple[str, ...]
    energy: float
    off_form: float
    left: float
    joint: float
    probability: float
    imitation: str


class Result(Model):
    """One set. discrepancy: squares of the discrepancy of the right names' forms along each other effect, if any."""

    kind: Hidden
    effects: tuple[str, ...]
    seed: int
    explained: tuple[Names, ...]
    discrepancy: tuple[float, ...]

    @property
    def key(self) -> tuple[str, tuple[str, ...], int]:
        return self.kind, self.effects, self.seed


def sets(seeds: range) -> Iterator[tuple[Hidden, tuple[str, ...], int]]:
    """What is hidden, by seeds."""
    for seed in seeds:
        yield from (("single", (name,), seed) for name in FORMS)
        yield from (("distorted", (name,), seed) for name in FORMS if name not in UNDISTORTED)
        yield from (("outside", (name,), seed) for name in OUTSIDE)
        yield from (("pair", pair, seed) for pair in PAIRS)


def measured(kind: Hidden, effects: tuple[str, ...], seed: int) -> Result:
    """What right and wrong names leave in one set."""
    rng = np.random.default_rng(seed)
    of_set: tuple[Kind, FormName] = ("single", "distorted") if kind == "distorted" else (kind, "blind")
    dataset, _ = make_set(of_set[0], effects, LEVELS["strong"], seed, form=of_set[1])
    runs = usable_runs(dataset.split("train"))
    plain = fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)
    screening = screen(plain, plain.nuisance_free_residuals, make_groups(plain, ()))
    right = _best_shapes(screening, effects) if kind != "outside" else []
    explained, discrepancy = [], ()
    if right:
        extended = extend(plain, right)
        screening = screen(extended.fit, extended.residuals_without_effects, screening.groups)
        right = _best_shapes(screening, effects)
        explained.append(_names(screening, right, rng, right=True))
        discrepancy = _discrepancy(screening.beyond_matrix, right, _others(screening, effects))
    for count in (1, 2):
        wrong = _largest(screening.beyond_matrix, _others(screening, effects), count)
        explained.append(_names(screening, wrong, rng, right=False))
    return Result(kind=kind, effects=effects, seed=seed, explained=tuple(explained), discrepancy=discrepancy)


def _best_shapes(screening: Screening, names: Sequence[str]) -> list[Group]:
    """The shape of each named effect that explains most."""
    start = screening.beyond_matrix
    return [
        max((g for g in screening.groups.effects if g.name == name), key=lambda group: start.chi_square(group.index))
        for name in names
    ]


def _others(screening: Screening, names: Sequence[str]) -> list[Group]:
    """All other effects that are not absorbed, each in its best shape."""
    other = {group.name for group in screening.tellable} - set(names)
    return _best_shapes(screening, sorted(other))


def _largest(start: Given, groups: Sequence[Group], count: int) -> list[Group]:
    """The effects that explain most together."""
    return list(max(combinations(groups, count), key=lambda some: start.chi_square(indices_of(some))))


def _discrepancy(start: Given, right: Sequence[Group], others: Sequence[Group]) -> tuple[float, ...]:
    """(Q / d - 1) / N of the other effects beyond the right ones: delta^2 of Eq. (3) of select.py (1), along each."""
    after = start.given(indices_of(right))
    energy = start.chi_square(indices_of(right)) - start.rank(indices_of(right))
    seen = [(after.chi_square(group.index), after.rank(group.index)) for group in others]
    return tuple((chi_square / rank - 1) / energy for chi_square, rank in seen if rank)


def _names(screening: Screening, chosen: Sequence[Group], rng: np.random.Generator, *, right: bool) -> Names:
    data, bases, start = screening.data, screening.groups.bases, screening.beyond_matrix
    fitted = screening.index_with(chosen)
    forms = [index for group in chosen for index in group.forms]
    left, beyond = (significance_of(data, columns, bases, rng) for columns in (fitted, [*fitted, *forms]))
    sets_ = effect_sets(start, chosen, len(chosen))
    credibility = credibility_of(sets_, start, chosen, left, beyond)
    return Names(
        right=right,
        names=tuple(group.name for group in chosen),
        energy=sets_.energy,
        off_form=credibility.off_form,
        left=credibility.left_share,
        joint=joint_share(start, chosen),
        probability=credibility.probability,
        imitation=credibility.imitation,
    )


def print_table(results: Sequence[Result]) -> None:
    """The figures that select.py names."""
    of_sets = [result.discrepancy for result in results if result.kind == "single"]
    print(f"discrepancy along other effects, {len(of_sets)} sets with one effect")
    for words, squares in (("mean", map(np.mean, of_sets)), ("largest", map(max, of_sets))):
        roots = np.sqrt(np.maximum(list(squares), 0.0))
        print(f"   {words:8} 50, 75, 90, 100 % of sets {np.round(np.quantile(roots, [0.5, 0.75, 0.9, 1.0]), 3)}")
    for distorted in (False, True):
        some = [names for result in results if (result.kind == "distorted") is distorted for names in result.explained]
        _print_names(some, " in distorted forms" if distorted else "")


def _print_names(every: Sequence[Names], words: str) -> None:
    for right, count in product((True, False), (1, 2)):
        some = [names for names in every if names.right == right and len(names.names) == count]
        if not some:
            continue
        print(f"\n{'right' if right else 'wrong'} names{words}, {count} at a time, {len(some)} sets")
        for field in ("off_form", "left", "joint", "probability"):
            values = np.array([getattr(names, field) for names in some])
            deciles = np.quantile(values, [0.1, 0.25, 0.5, 0.75, 0.9])
            print(f"   {field:12} mean {values.mean():.3f}   10, 25, 50, 75, 90 % {np.round(deciles, 3)}")
        for reason, times in sorted(Counter(names.imitation for names in some if names.imitation).items()):
            print(f"   imitation: {reason} {times}")
    for count in (1, 2):
        low, high = sure_odds([names for names in every if len(names.names) == count and not names.imitation])
        print(f"\nwith {low:.2g} to {high:.2g} times the odds of {count}, all right names are sure, and no wrong one")


def sure_odds(every: Sequence[Names]) -> tuple[float, float]:
    """Factors on the odds of names, from which on all right ones are sure, and up to which no wrong one is."""
    right, wrong = ([names.probability for names in every if names.right == side] for side in (True, False))
    sure = SURE / (1 - SURE)
    return sure * (1 / min(right, default=1.0) - 1), sure * (1 / max(wrong) - 1) if wrong else np.inf


def main() -> None:
    """Measure the sets that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of results, one line of JSON a set")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    arguments = parser.parse_args()
    file = ResultsFile(arguments.out, Result)
    done = {result.key for result in file.results}
    if not arguments.table:
        with one_thread():
            for each in sets(range(FIRST_SEED, FIRST_SEED + arguments.seeds)):
                if each not in done:
                    file.add(measured(*each))
    print_table(file.results)


if __name__ == "__main__":
    main()
