"""Figures of the main table, with their intervals, from the results of a study."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from scipy.stats import binomtest

from .judging import CONFIDENT, Judgement, Outcome
from .sets import LEVELS
from .tasks import Group, Result

STRONG, MEDIUM, WEAK = (LEVELS[name] for name in ("strong", "medium", "weak"))
Test = Callable[[Judgement], bool]


@dataclass(frozen=True)
class Row:
    """A line of the table, in words."""

    figure: str
    least: str
    aim: str
    seen: str


def of_group(results: Iterable[Result], *groups: Group, level: float | None = None) -> list[Result]:
    """Results of these groups and this level, without those whose effect would have to be implausibly large."""
    wanted = [each for each in results if each.task.group in groups and each.reachable]
    return [each for each in wanted if level is None or each.task.level == level]


def rate(results: Sequence[Result], test: Test, *, failed: bool = False) -> str:
    """How many pass, with the 95 % interval of Wilson. failed: what a failure of the workflow counts as."""
    hits = sum(failed if each.judgement is None else test(each.judgement) for each in results)
    if not results:
        return "-"
    interval = binomtest(hits, len(results)).proportion_ci(0.95, "wilson")
    return f"{hits / len(results):.1%} ({interval.low:.1%} to {interval.high:.1%}) of {len(results)}"


def right(judged: Judgement) -> bool:
    """The right name, nothing else with confidence."""
    return judged.outcome == "right" and not judged.confident_wrong


def right_or_class(judged: Judgement) -> bool:
    """The right name or a class that holds it, nothing else with confidence."""
    return judged.outcome in ("right", "class") and not judged.confident_wrong


def _named(judged: Judgement) -> bool:
    return judged.outcome in ("right", "class", "wrong")


def issue_table(results: Sequence[Result]) -> list[Row]:
    """The main table."""
    null, removed = of_group(results, "null"), of_group(results, "removed")
    return [
        *(_names(results, "matched", "textbook forms", level, *asked) for level, asked in _TEXTBOOK.items()),
        *(_names(results, "single", "second forms", level, "", "") for level in _TEXTBOOK),
        *(_names(results, "third", "third forms", level, *asked) for level, asked in _THIRD.items()),
        Row("wrong name where nothing is hidden", "<= 0.5 %", "<= 0.5 %", rate(null, _named, failed=True)),
        *(_outside_row(results, level, *asked) for level, asked in _OUTSIDE.items()),
        Row(
            "outside, both: no confident wrong name", "98 %", "99 %",
            rate(of_group(results, "outside", "fine"), lambda each: not each.confident_wrong),
        ),
        Row(
            "gap closed in truth where unknown and something is there", ">= 50 %", "70 %",
            _share(_closed_unknown(results)),
        ),
        Row("true effect removed, confident wrong name", "<= 2 %", "1 %", rate(removed, _confident, failed=True)),
        Row("time of one set, median and 95th percentile", "6 s", "3 s", _times(_seconds(results))),
    ]  # fmt: skip


_TEXTBOOK = {STRONG: ("98 %", "99.5 %"), MEDIUM: ("95 %", "98 %")}
_THIRD = {STRONG: ("90 %", "97 %"), MEDIUM: ("80 %", "90 %")}
_OUTSIDE = {STRONG: ("98 %", "99 %"), MEDIUM: ("90 %", "97 %")}


def _names(results: Sequence[Result], group: Group, forms: str, level: float, least: str, aim: str) -> Row:
    words = f"right name or class, {forms}, non-centrality {level:g}"
    return Row(words, least, aim, rate(of_group(results, group, level=level), right_or_class))


def _outside_row(results: Sequence[Result], level: float, least: str, aim: str) -> Row:
    words = f"outside the catalogue, fine structure too: flagged at {level:g}"
    return Row(words, least, aim, rate(of_group(results, "outside", "fine", level=level), _flagged))


def _flagged(judged: Judgement) -> bool:
    """Said to be without a name; or with the one that the catalogue has for it after all (Unheard.called)."""
    return judged.verdict in ("unknown", "incomplete") or judged.outcome == "right"


def _closed_unknown(results: Sequence[Result]) -> Iterable[float | None]:
    for each in of_group(results, "single", "matched", "third", "pair", "outside", "fine"):
        if each.judgement is not None and each.judgement.verdict == "unknown":
            yield each.judgement.closed_true_chi2


def _seconds(results: Sequence[Result]) -> list[float]:
    return [each.judgement.seconds for each in results if each.judgement]


def further_table(results: Sequence[Result]) -> list[Row]:
    """Further figures, which the main table does not contain."""
    strong, weak = (of_group(results, "single", level=level) for level in (STRONG, WEAK))
    null = of_group(results, "null")
    every = of_group(results, "single", "null", "pair", "outside", "fine", "matched", "third")
    noises = sorted({each.noise for each in null})
    outside = of_group(results, "outside", "fine", level=STRONG)
    judged = [each.judgement for each in strong if each.judgement]
    return [
        Row("two effects, both right", "90 %", "97 %", rate(of_group(results, "pair"), lambda each: each.both_right)),
        Row(
            "gap closed, strong, said (chi2, median)", "92 %", "97 %", _share(each.closed_said_chi2 for each in judged)
        ),
        Row(
            "gap closed, strong, said (Eq. 6, median)", "92 %", "97 %", _share(each.closed_said_eq6 for each in judged)
        ),
        Row("gap closed, strong, in truth (chi2, median)", "92 %", "97 %", _share(_true_where_said(judged, "chi2"))),
        Row("parameter error, strong, median", "8 %", "4 %", _share(each.parameter_error for each in judged)),
        Row("coverage of 95 % intervals, strong", "90-98 %", "93-97 %", _coverage(judged)),
        Row("error of stated weights", "0.08", "0.03", weight_error(of_group(results, "single", "null"))),
        Row("absorbed effects named", "0", "0", rate(of_group(results, "absorbed"), _named, failed=True)),
        *(_names(results, group, forms, WEAK, "", "") for group, forms in _FORMS),
        Row("confident wrong name, medium", "", "", rate(of_group(results, "single", level=MEDIUM), _confident_wrong)),
        Row("confident wrong name, weak", "", "", rate(weak, _confident_wrong)),
        Row("unknown, nothing hidden", "", "", rate(null, lambda each: each.verdict == "unknown")),
        *(Row(f"wrong name, noise {kind}", "", "", rate(_of_noise(null, kind), _named)) for kind in noises),
        Row("two effects, both right, no wrong third", "", "", rate(of_group(results, "pair"), _both_and_no_more)),
        Row("outside: right covariate in the top two", "", "", rate(outside, lambda each: each.where_right)),
        Row("outside: confident wrong name", "", "", rate(outside, _confident_wrong)),
        Row("fine structure, flagged", "", "", rate(of_group(results, "fine", level=STRONG), _flagged)),
        Row("fine structure, flagged at 300", "", "", rate(of_group(results, "fine", level=MEDIUM), _flagged)),
        Row(
            "fine structure, by the name that the catalogue has for it",
            "",
            "",
            rate(of_group(results, "fine"), _first),
        ),
        Row("fine structure: confident wrong name", "", "", rate(of_group(results, "fine"), _confident_wrong)),
        Row("error of stated weights, all sets", "", "", weight_error(every)),
        Row("nuisances named", "", "", rate(of_group(results, "nuisance"), _named)),
        Row("actuator effects, right name", "", "", rate(of_group(results, "actuator"), right)),
        Row("not reachable within 3 plausible ranges", "", "", str(sum(not each.reachable for each in results))),
        Row("failures of the workflow", "", "", str(sum(each.judgement is None for each in results))),
    ]


def effect_lines(results: Sequence[Result]) -> list[str]:
    """One line for every group, effect and level: what was answered."""
    cells: dict[tuple[str, str, float], list[Result]] = {}
    for each in results:
        cells.setdefault((each.task.group, "+".join(each.task.effects), each.task.level), []).append(each)
    lines = [
        f"{'group':9}{'hidden':49}{'level':>6}{'sets':>5}{'right':>6}{'class':>6}{'wrong':>6}{'unkn.':>6}{'none':>5}"
        f"{'conf. wrong':>12}{'weight':>7}{'par. err.':>10}{'closed':>7}{'size':>6}"
    ]
    for (group, name, level), members in sorted(cells.items()):
        judged = [each.judgement for each in members if each.judgement]
        counts = [sum(each.outcome == outcome for each in judged) for outcome in get_args(Outcome)]
        weights = [each.names[0].weight for each in judged if each.names]
        lines.append(
            f"{group:9}{name:49}{level:6g}{len(members):5}{counts[0]:6}{counts[1]:6}{counts[2]:6}{counts[3]:6}"
            f"{counts[4]:5}{sum(each.confident_wrong for each in judged):12}{_median(weights):>7}"
            f"{_median(each.parameter_error for each in judged):>10}"
            f"{_median(each.closed_true_chi2 for each in judged):>7}"
            f"{float(np.median([each.size for each in members])):6.2f}"
        )
    return lines


def weight_error(results: Sequence[Result]) -> str:
    """Expected calibration error of the first names' weights, in ten bins, and the bins."""
    names = [each.judgement.names[0] for each in results if each.judgement and each.judgement.names]
    if not names:
        return "-"
    weights, hits = np.array([name.weight for name in names]), np.array([name.right for name in names], dtype=float)
    bins = np.minimum((10 * weights).astype(int), 9)
    members = [bins == number for number in np.unique(bins)]
    error = sum(abs(float(hits[each].mean() - weights[each].mean())) * each.sum() for each in members) / len(names)
    shown = "; ".join(f"{weights[each].mean():.2f}: {hits[each].mean():.2f} of {each.sum()}" for each in members)
    return f"{error:.3f} ({shown})"


def _first(judged: Judgement) -> bool:
    return judged.outcome == "right"


def _confident_wrong(judged: Judgement) -> bool:
    return judged.confident_wrong


def _both_and_no_more(judged: Judgement) -> bool:
    return judged.both_right and not judged.confident_wrong


def _of_noise(results: Sequence[Result], kind: str) -> list[Result]:
    return [each for each in results if each.noise == kind]


def _confident(judged: Judgement) -> bool:
    return any(name.weight >= CONFIDENT for name in judged.names)


_FORMS: tuple[tuple[Group, str], ...] = (
    ("matched", "textbook forms"),
    ("single", "second forms"),
    ("third", "third forms"),
)


def _true_where_said(judged: Sequence[Judgement], metric: str) -> Iterable[float | None]:
    """Only where the discovery found the gap larger than two standard errors."""
    for each in judged:
        if getattr(each, f"closed_said_{metric}") is not None:
            yield getattr(each, f"closed_true_{metric}")


def _share(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    tenth, ninth = np.quantile(known, [0.1, 0.9])
    return f"{np.median(known):.1%} (mean {np.mean(known):.1%}, 80 % in {tenth:.1%} to {ninth:.1%}) of {len(known)}"


def _coverage(judged: Sequence[Judgement]) -> str:
    covered = [parameter.covered for each in judged for parameter in each.parameters]
    if not covered:
        return "-"
    interval = binomtest(sum(covered), len(covered)).proportion_ci(0.95, "wilson")
    return f"{np.mean(covered):.1%} ({interval.low:.1%} to {interval.high:.1%}) of {len(covered)} intervals"


def _times(times: Sequence[float]) -> str:
    return f"{np.median(times):.1f} s, {np.quantile(times, 0.95):.1f} s" if times else "-"


def _median(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.median(known):.2f}" if known else "-"
