"""Figures that the README and the pages on the paper and on discover print: measured anew and written into the pages.

    python tests/studies/page_figures.py [--only paper chain omni3 discovery] [--check]

paper: configs/apr02.yaml. chain: theoretical and calibrated costs of apr02_robot and apr02_floor. omni3, discovery:
configs/omni3.yaml and ``discover`` on the recordings at ../shared/data. All take half an hour on two processors.
--check writes nothing and ends with 1 if a page differs. The suite holds the pages to what its tests run anyway.
Rates of names are discover_study's, figures of six robots those of configs/real_robots.yaml.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from commands import CONFIGS, RECORDINGS, ROOT, compared, rows, summary

from omnibench.cli.handbook_topics import find_topic
from omnibench.data.dataset import Dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.result import Discovery
from omnibench.fit.evaluate import final_errors
from omnibench.fit.intervals import Bootstrap, RatioIntervals, units_of
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

README, PAPER, DISCOVER = ROOT / "README.md", find_topic("paper").file, find_topic("discover").file
EVALUATIONS = ("matrix_least", "matrix_most", "geometry_least", "geometry_most", "fewer", "crs_least", "crs_most")
NUMBER = r"-?\d+(?:,\d{3})*(?:\.\d+)?"
Figures = Mapping[str, str]


@dataclass(frozen=True)
class Passage:
    """Words of a page with figures in braces, wherever its lines break."""

    page: Path
    words: str

    @property
    def names(self) -> list[str]:
        return re.findall(r"\{(\w+)\}", self.words)

    def match(self, text: str) -> re.Match[str]:
        parts = re.split(r"(\{\w+\}|\s+)", self.words)
        pattern = "".join(
            rf"(?P<{part[1:-1]}>{NUMBER})" if part.startswith("{") else r"\s+" if part.isspace() else re.escape(part)
            for part in parts
        )
        found = re.search(pattern, text)
        assert found is not None, f"{self.page.name} does not say: {self.words}"
        return found

    def printed(self) -> dict[str, str]:
        """The figures as the page prints them."""
        return self.match(self.page.read_text(encoding="utf-8")).groupdict()

    def write(self, figures: Figures) -> None:
        text = self.page.read_text(encoding="utf-8")
        found = self.match(text)
        for name in sorted(self.names, key=found.start, reverse=True):
            text = text[: found.start(name)] + figures[name] + text[found.end(name) :]
        self.page.write_text(text, encoding="utf-8")


PASSAGES: Mapping[str, Sequence[Passage]] = {
    "paper": (
        Passage(
            PAPER, "{matrix_least} to {matrix_most} evaluations for the matrix, {geometry_least} to {geometry_most} for"
        ),
        Passage(PAPER, "by the medians {fewer} % fewer"),
        Passage(PAPER, "its lowest cost is {higher} % higher"),
        Passage(PAPER, "`crs` needs {crs_least} to {crs_most}"),
        Passage(PAPER, "`closed_form` {closed_form}"),
        Passage(PAPER, "{curves} in curves, {straight} straight"),
        Passage(
            PAPER,
            "lowest cost in the paper's box is {in_paper}, in the box `row` {in_row}; "
            "on held-out runs both give {held_out}.",
        ),
        Passage(PAPER, "`apr02`: noise chosen for these figures | {theoretical} | {in_row_too} | {held_out_too} |"),
    ),
    "chain": (
        Passage(PAPER, "straight ({apr02_robot_straight}) as in curves ({apr02_robot_curves})"),
        *(
            Passage(PAPER, f"{words} | {{{name}_theoretical}} | {{{name}_calibrated}} | {{{name}_held_out}} |")
            for name, words in (
                ("apr02_robot", "`apr02_robot`: even floor, no slip"),
                ("apr02_floor", "`apr02_floor`: the same robot, floor and slip chosen by hand"),
            )
        ),
    ),
    "omni3": (
        Passage(README, "the matrix alone saves {saved} % of the cost on runs held out"),
        Passage(README, "the 95 % interval is {low} to {high} % over its five commands"),
        Passage(README, "over its 23 runs it would be {low_of_runs} to {high_of_runs} %"),
    ),
    "discovery": (
        Passage(README, "falls from {m_before} m and {deg_before} deg to {m_after} m and {deg_after} deg"),
        Passage(
            DISCOVER,
            "whichever it is ({right} of 100 cases), how often after as many minutes of the commands "
            "that were recorded ({right_recorded} of 100)",
        ),
    ),
}


def paper_figures(results: Path) -> Figures:
    """Figures of a comparison by configs/apr02.yaml. Evaluations differ between processors, so ranges are printed."""
    runs, entries = summary(results)["runs"], rows(results)

    def evaluations(label: str) -> list[int]:
        return sorted(run["evaluations"] for run in runs if run["label"] == label)

    matrix, geometry, crs = evaluations("genetic"), evaluations("parametric (GA)"), evaluations("crs")
    paper, row = entries["closed_form"], entries["closed_form (row box)"]
    held_out = {f"{entry['validation_cost']:.4f}" for entry in (paper, row)}
    assert len(held_out) == 1  # "both give"
    (held_out_cost,) = held_out
    return {
        "matrix_least": f"{matrix[0]:,}",
        "matrix_most": f"{matrix[-1]:,}",
        "geometry_least": f"{geometry[0]:,}",
        "geometry_most": f"{geometry[-1]:,}",
        "fewer": f"{100 * (1 - np.median(matrix) / np.median(geometry)):.0f}",
        "higher": f"{100 * (paper['train_cost'] / row['train_cost'] - 1):.1f}",
        "crs_least": f"{crs[0]:,}",
        "crs_most": f"{crs[-1]:,}",
        "closed_form": f"{paper['evaluations']}",
        **straight_and_curves(results),
        "in_paper": f"{paper['train_cost']:.4f}",
        "in_row": f"{row['train_cost']:.4f}",
        "held_out": held_out_cost,
        "theoretical": f"{paper['theoretical_train_cost']:.4f}",
        "in_row_too": f"{paper['train_cost']:.4f}",
        "held_out_too": held_out_cost,
    }


def straight_and_curves(results: Path, prefix: str = "") -> dict[str, str]:
    """Eq. (6) of the theoretical matrix on held-out runs that go straight, and on those in curves."""
    held_out = pl.read_parquet(results / "errors.parquet").filter(label="theoretical", split="validation")
    straight = held_out["command"].str.ends_with("_w0")
    kinds = (("straight", straight), ("curves", ~straight))
    return {f"{prefix}{name}": f"{held_out.filter(chosen)['cost'].mean():.3f}" for name, chosen in kinds}


def chain_figures(results: Mapping[str, Path]) -> Figures:
    """Costs of closed_form on the simulated robots, by the names of their configs."""
    costs = {name: rows(folder)["closed_form"] for name, folder in results.items()}
    return straight_and_curves(results["apr02_robot"], "apr02_robot_") | {
        f"{name}_{part}": f"{row[key]:.4f}"
        for name, row in costs.items()
        for part, key in (
            ("theoretical", "theoretical_train_cost"),
            ("calibrated", "train_cost"),
            ("held_out", "validation_cost"),
        )
    }


def omni3_figures(results: Path, omni3: Dataset) -> Figures:
    """The improvement on omni3's squares by closed_form, with its intervals over commands and over runs."""
    runs, intervals = omni3.split("validation"), RatioIntervals(Bootstrap())
    design = OdometryModel.of_design(omni3.robot, "arc")
    fitted = OdometryModel(omni3.robot, np.array(rows(results)["closed_form"]["matrix"]), "arc")
    after, before = (np.linalg.norm(final_errors(model, runs), axis=1) for model in (fitted, design))
    figures = {}
    for unit, of in (("command", ""), ("run", "_of_runs")):
        gain = intervals.improvement(after, before, units_of(runs, unit))
        assert gain is not None
        assert gain.known is not None
        assert gain.holds(0.0)  # undecided, as the README says
        figures |= {"saved": f"{100 * gain.value:.1f}"}
        figures |= {f"{name}{of}": f"{100 * end:.1f}" for name, end in zip(("low", "high"), gain.known, strict=True)}
    return figures


def discovery_figures(discovery: Discovery) -> Figures:
    """Errors on omni3's squares before and after discover, and the chances of the runs that it proposes."""
    squares, (experiment,) = discovery.held_out[-1], discovery.experiments
    (m_before, m_after), headings = squares.position_m, np.degrees(squares.heading_rad)
    return {
        "m_before": f"{m_before:.3f}",
        "m_after": f"{m_after:.3f}",
        "deg_before": f"{headings[0]:.1f}",
        "deg_after": f"{headings[1]:.1f}",
        "right": f"{100 * experiment.chance:.0f}",
        "right_recorded": f"{100 * experiment.chance_recorded:.0f}",
    }


def plan_lines(discovery: Discovery) -> str:
    """The driving plan of the page on discover."""
    (experiment,) = discovery.experiments
    width = max(len(command.motion) for command in experiment.commands)
    lines = [
        f"What to drive to tell {experiment.separates[0]} from its look-alikes",
        f"{'Drive':{width}} Each (s) Runs",
    ]
    lines += [f"{each.motion:{width}} {each.seconds:8.1f} {each.runs:4d}" for each in experiment.commands]
    return "".join(f"    {line}\n" for line in lines)


def printed_plan() -> re.Match[str]:
    found = re.search(
        r"(?:    .*\n)+", DISCOVER.read_text(encoding="utf-8").partition("on omni wheels, recorded on circles:\n")[2]
    )
    assert found is not None
    return found


def write_plan(discovery: Discovery) -> None:
    text = DISCOVER.read_text(encoding="utf-8")
    DISCOVER.write_text(text.replace(printed_plan().group(), plan_lines(discovery)), encoding="utf-8")


def assert_printed(part: str, figures: Figures, skipped: Sequence[str] = ()) -> None:
    """AssertionError where the pages print other figures of a part than these."""
    for passage in PASSAGES[part]:
        printed = {name: text for name, text in passage.printed().items() if name not in skipped}
        assert printed == {name: figures[name] for name in printed}, passage.words


def compared_with(name: str, folder: Path, **changes: Any) -> Path:
    """The results of a config of ours after some changes."""
    content = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    content |= {"plugins": [str(ROOT / "plugins")]} | changes
    config = folder / f"{name}.yaml"
    config.write_text(yaml.safe_dump(content), encoding="utf-8")
    compared(config, folder / name, "--data", RECORDINGS / "optiodom" / "omni3") if name == "omni3" else compared(
        config, folder / name
    )
    return folder / name


def chain_results(folder: Path) -> dict[str, Path]:
    few = {"calibrators": ["theoretical", "closed_form"], "published_results": [], "certificate": None}
    return {name: compared_with(name, folder, **few) for name in ("apr02_robot", "apr02_floor")}


def omni3_dataset() -> Dataset:
    return import_dataset("optiodom", RECORDINGS / "optiodom" / "omni3", {"train": "circular", "validation": "square"})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(PASSAGES), default=list(PASSAGES))
    parser.add_argument("--check", action="store_true", help="write nothing; end with 1 if a page differs")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        discoveries: list[Discovery] = []

        def discovered() -> Figures:
            discoveries.append(discover_effects(omni3_dataset()))
            return discovery_figures(discoveries[0])

        measured: Mapping[str, Callable[[], Figures]] = {
            "paper": lambda: paper_figures(compared_with("apr02", folder)),
            "chain": lambda: chain_figures(chain_results(folder)),
            "omni3": lambda: omni3_figures(
                compared_with("omni3", folder, calibrators=["theoretical", "closed_form"]), omni3_dataset()
            ),
            "discovery": discovered,
        }
        for part in arguments.only:
            figures = measured[part]()
            sys.stdout.write(f"{part}: {figures}\n")
            if arguments.check:
                assert_printed(part, figures)
                assert not discoveries or printed_plan().group() == plan_lines(discoveries[0])
                continue
            for passage in PASSAGES[part]:
                passage.write(figures)
            if part == "discovery":
                write_plan(discoveries[0])


if __name__ == "__main__":
    main()
