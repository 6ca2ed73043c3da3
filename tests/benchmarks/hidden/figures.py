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


def _outside(judged: Judgement) -> bool:
    return judged.verdict == "unknown" and judged.where_right and not judged.confident_wrong


def issue_table(results: Sequence[Result]) -> list[Row]:
    """The main table."""
    strong, medium = of_group(results, "single", level=STRONG), of_group(results, "single", level=MEDIUM)
    outside = of_group(results, "outside", level=STRONG)
    judged = [each.judgement for each in strong if each.judgement]
    times = [each.judgement.seconds for each in results if each.judgement]
    return [
        Row("right name, strong", "97 %", "99 %", rate(strong, right)),
        Row("right name or right class, medium", "90 %", "97 %", rate(medium, right_or_class)),
        Row("wrong name, nothing hidden", "<= 1 %", "<= 0.5 %", rate(of_group(results, "null"), _named, failed=True)),
        Row("two effects, both right", "90 %", "97 %", rate(of_group(results, "pair"), lambda each: each.both_right)),
        Row("outside the catalogue, found so", "90 %", "98 %", rate(outside, _outside)),
        Row("true effect removed, confident wrong name", "<= 5 %", "<= 1 %", _removed(results)),
        Row("gap closed, said (chi2, median)", "92 %", "97 %", _share(each.closed_said_chi2 for each in judged)),
        Row("gap closed, said (Eq. 6, median)", "92 %", "97 %", _share(each.closed_said_eq6 for each in judged)),
        Row("gap closed, in truth (chi2, median)", "92 %", "97 %", _share(_true_where_said(judged, "chi2"))),
        Row("gap closed, in truth (final poses, median)", "92 %", "97 %", _share(_true_where_said(judged, "eq6"))),
        Row("parameter error, strong, median", "8 %", "4 %", _share(each.parameter_error for each in judged)),
        Row("coverage of 95 % intervals, strong", "90-98 %", "93-97 %", _coverage(judged)),
        Row("error of stated weights", "0.08", "0.03", weight_error(of_group(results, "single", "null"))),
        Row("absorbed effects named", "0", "0", rate(of_group(results, "absorbed"), _named, failed=True)),
        Row("time of one set, median and 95th percentile", "20 s", "5 s", _times(times)),
    ]


def further_table(results: Sequence[Result]) -> list[Row]:
    """Further figures, which the main table does not contain."""
    strong, weak = (of_group(results, "single", level=level) for level in (STRONG, WEAK))
    null, every = (
        of_group(results, "null"),
        of_group(results, "single", "null", "pair", "outside", "fine", "matched", "third"),
    )
    noises = sorted({each.noise for each in null})
    outside = of_group(results, "outside", level=STRONG)
    return [
        Row("right name, strong, whatever else is named", "", "", rate(strong, _first)),
        Row("right name or right class, weak", "", "", rate(weak, right_or_class)),
        Row("right name, strong, matched forms", "", "", rate(of_group(results, "matched", level=STRONG), right)),
        Row("the same, medium, or class", "", "", rate(of_group(results, "matched", level=MEDIUM), right_or_class)),
        Row(
            "right name or class, strong, third forms",
            "",
            "",
            rate(of_group(results, "third", level=STRONG), right_or_class),
        ),
        Row("the same, medium", "", "", rate(of_group(results, "third", level=MEDIUM), right_or_class)),
        Row("confident wrong name, medium", "", "", rate(of_group(results, "single", level=MEDIUM), _confident_wrong)),
        Row("confident wrong name, weak", "", "", rate(weak, _confident_wrong)),
        Row("unknown, nothing hidden", "", "", rate(null, lambda each: each.verdict == "unknown")),
        *(Row(f"wrong name, noise {kind}", "", "", rate(_of_noise(null, kind), _named)) for kind in noises),
        Row("two effects, both right, no wrong third", "", "", rate(of_group(results, "pair"), _both_and_no_more)),
        Row("outside: verdict unknown", "", "", rate(outside, lambda each: each.verdict == "unknown")),
        Row("outside: right covariate in the top two", "", "", rate(outside, lambda each: each.where_right)),
        Row("outside: confident wrong name", "", "", rate(outside, _confident_wrong)),
        Row("outside, fainter: found so", "", "", rate(of_group(results, "outside", level=300.0), _outside)),
        Row("fine structure, found so", "", "", rate(of_group(results, "fine", level=STRONG), _outside)),
        Row("fine structure, fainter: found so", "", "", rate(of_group(results, "fine", level=300.0), _outside)),
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


def _removed(results: Sequence[Result]) -> str:
    """Without its name in the catalogue, no name is right."""
    return rate(of_group(results, "removed"), _confident, failed=True)


def _confident(judged: Judgement) -> bool:
    return any(name.weight >= CONFIDENT for name in judged.names)


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
