"""All variants of the table, their answers, and the table of passes."""

from __future__ import annotations

import argparse
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from strangers.judge import ROOT, Answer, Case, Right, Variant
from strangers.make import make

PATTERN = r"command_pattern=(.*)_\d"
TABLE: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("table.yaml").read_text())


def variants(shared: Path) -> Iterator[Variant]:
    """The rows of the table; those of shared cases where they are there."""
    for kind in TABLE["kinds"]:
        for more in kind["rows"]:
            row = kind["all"] | more
            row["says"] = [*kind["all"].get("says", []), *more.get("says", [])]
            unit, more = row.get("unit"), row.get("options", [])
            typed = [f"wheel_unit={unit[0]}", *(f"ticks_per_turn={n}" for n in unit[1:]), PATTERN] if unit else []
            row["options"] = [*typed, *more]
            if "case" in row:
                files = [row["files"], *(option for option in more if option.startswith("robot="))]
                row["name"] = f"{row['case']}/{' '.join(files).removesuffix('.yaml').removesuffix(' robot=robot')}"
            elif "car" not in row:
                row["name"] = f"{row['robot']}, {row['name']}"
            right = Right(**{each.name: row[each.name] for each in fields(Right) if each.name in row})
            if "case" not in row or shared.is_dir():
                yield Variant(kind["kind"], row["name"], row, right)


def sit(variant: Variant, folder: Path, shared: Path, keep: bool) -> tuple[Answer, float]:
    """The answer to a variant, and how many seconds it took."""
    begin = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    answer = Case(variant, folder, make(variant.row, folder, shared)).judged()
    (folder / "typed.txt").write_text("\n".join(answer.typed))
    if not keep:
        shutil.rmtree(folder)
    return answer, time.monotonic() - begin


def shown(results: list[tuple[Variant, Answer]]) -> str:
    """What was wrong, and passes by kind."""
    lines = ["", "what was wrong:"]
    for variant, answer in results:
        lines += [f"  {variant.kind}. {variant.name}: {statement}" for statement in answer.wrong]
    lines += ["", f"{'kind':36}{'passed':>8}{'of':>5}"]
    for kind in TABLE["kinds"]:
        answers = [answer for variant, answer in results if variant.kind == kind["kind"]]
        if answers:
            passed = sum(not answer.wrong for answer in answers)
            lines.append(f"{kind['kind']:2}. {kind['title']:32}{passed:8}{len(answers):5}")
    lines.append(f"{'all':36}{sum(not answer.wrong for _, answer in results):8}{len(results):5}")
    return "\n".join(lines)


def main(description: str | None) -> int:
    kinds = [kind["kind"] for kind in TABLE["kinds"]]
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", type=int, nargs="+", default=kinds, choices=kinds)
    parser.add_argument("--only", default="", help="regular expression of the variants' names")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared" / "cases", help="the folder of cases")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="the variants, and what is typed first")
    parser.add_argument("--keep", type=Path, help="folder in which the recordings and what was made of them stay")
    given = parser.parse_args()
    shared = given.shared.resolve()
    chosen = [v for v in variants(shared) if v.kind in given.kinds and re.search(given.only, v.name)]
    if given.list:
        print("\n".join(f"{v.kind:2}. {v.name}: {' '.join(v.row['options'])}" for v in chosen))
        return 0
    answers: dict[int, Answer] = {}
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(given.jobs) as pool:
        place = (given.keep or Path(scratch)).resolve()
        sat = {pool.submit(sit, v, place / f"{n:03d}", shared, bool(given.keep)): n for n, v in enumerate(chosen)}
        for ended, future in enumerate(as_completed(sat), 1):
            variant = chosen[number := sat[future]]
            answers[number], seconds = future.result()
            words = "right" if not answers[number].wrong else f"WRONG {'; '.join(answers[number].wrong)}"
            head = f"[{ended}/{len(chosen)}] {number:03d} {variant.kind}. {variant.name} ({seconds:.0f} s)"
            print(f"{head}: {words[:400]}", flush=True)
    print(shown([(chosen[number], answers[number]) for number in sorted(answers)]))
    return 0
