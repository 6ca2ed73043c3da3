"""Study of the experiments that ``omnibench discover`` proposes: do they tell a class of effects apart?

    python tests/studies/experiment_study.py --out experiments.jsonl [--seeds 10] [--omni3 FOLDER] [--table]

Where a set of 180 runs of one speed ends in a class, the runs that are proposed are driven by the same hidden robot,
and what is discovered in both recordings together is compared with the chance that was promised; so is what as many
more minutes of the recorded commands tell. Sets and further runs are made by tests/studies/hidden, without the code
of omnibench. With --omni3 the recording is INESC TEC's robot on circles, and truth is each member of its class in turn,
as fitted: its recorded wheels are driven again, and the proposed runs are simulated, by omnibench itself.
One line of JSON a set: run again with the same file, and it goes on where it was. Seeds from 2000 on are for tuning.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hidden.forms import FORMS
from hidden.further import joined, proposed_runs, recorded_again
from hidden.sets import make_set
from results_file import ResultsFile
from scipy.stats import binomtest

import omnibench.discover.confirm as confirming
from omnibench.config import Model, parse_yaml
from omnibench.data.dataset import Dataset
from omnibench.data.splits import joined as joined_datasets
from omnibench.discover.confirm import CompetingModels
from omnibench.discover.discover import discover_effects
from omnibench.discover.result import Discovery, NamedEffect
from omnibench.processes import one_thread
from omnibench.robot.calibration import EffectTerm
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset, simulate_like
from omnibench.slam.import_dataset import import_dataset

SURE = 0.95  # weight of a sure name
LEVELS = (1000.0, 300.0)  # non-centralities of the hidden effect in the recorded runs
EFFECTS = tuple(name for name in FORMS if name != "tyre_wear")  # which needs several sessions


class Answer(Model):
    """What is discovered in recorded and further runs. weight: of the true name, 0 if another one is first."""

    verdict: str
    names: tuple[str, ...]
    weight: float

    @property
    def sure(self) -> bool:
        return self.weight >= SURE

    @property
    def wrong(self) -> bool:
        """Another name is sure."""
        return self.verdict in ("named", "incomplete") and self.weight == 0


class Result(Model):
    """One set. names: its class; empty where there was none. chance, chance_recorded: as promised."""

    key: str
    truth: str
    verdict: str
    names: tuple[str, ...] = ()
    runs: int = 0
    minutes: float = 0.0
    chance: float = 0.0
    chance_recorded: float = 0.0
    inseparable: tuple[tuple[str, str], ...] = ()
    proposed: Answer | None = None
    recorded: Answer | None = None


def main() -> None:
    """Make the sets that are missing, then print the table."""
    arguments = _arguments()
    file = ResultsFile(arguments.out, Result)
    if not arguments.table:
        done = {each.key for each in file.results}
        sets = _omni3(arguments, done) if arguments.omni3 else _hidden(arguments, done)
        with one_thread():
            for result in sets:
                file.add(result)
                print(result, flush=True)
    print_table(file.results)


def hidden_set(name: str, level: float, seed: int, key: str = "", form: str = "blind") -> Result:
    """One effect hidden in a flower of 180 runs: recorded, discovered, and driven on as is proposed."""
    dataset, truth = make_set(
        "single", name, level, seed, design="flower", form="matched" if form == "matched" else "blind"
    )
    training = [run for run in truth.runs if run.split == "train"]
    found = discover_effects(replace(dataset, trajectories=dataset.split("train")), seed=seed)
    result = _result(found, key, name)
    if not result.names or name not in result.names or not result.runs:
        return result
    (experiment,) = found.experiments
    rng = np.random.default_rng([seed, 1])
    answers = [
        _answer(discover_effects(joined(dataset, truth, runs, rng), seed=seed), name)
        for runs in (proposed_runs(experiment.config, rng), recorded_again(training, experiment.minutes, rng))
    ]
    return result.model_copy(update={"proposed": answers[0], "recorded": answers[1]})


def omni3_sets(dataset: Dataset, seeds: Sequence[int], done: set[str]) -> Iterator[Result]:
    """Each member of omni3's class as the truth, in the recorded circles and in the proposed runs."""
    found, models = discovered_with_models(dataset)
    experiment = found.experiments[0]
    content = parse_yaml(experiment.config, "experiment")["datasets"]["experiment"]["simulate"]
    for _, model in models.weighted:
        (term,) = model.fit.model.terms
        noise = model.fit.noise.noise
        truth = EffectTerm(name=term.name, parameters={key: float(value) for key, value in term.values.items()})
        matrix = tuple(tuple(float(value) for value in row) for row in model.fit.model.matrix)
        calibration = found.extended.model_copy(update={"matrix": matrix, "effects": (truth,), "noise": noise})
        for seed in seeds:
            if (key := f"omni3 {term.name} {seed}") in done:
                continue
            circles = replace(dataset, trajectories=dataset.split("train"), warnings=())
            again = simulate_like(circles, calibration, 10 * seed)
            changed = {
                "truth": {"matrix": matrix, "effects": [truth.model_dump()]},
                "train": {"seed": 10 * seed + 1, "distance": 1.0},
            }
            proposed = simulate_dataset(FlowerConfig.model_validate(content | changed), "proposed").dataset
            more = simulate_like(_part(circles, experiment.minutes, seed), calibration, 10 * seed + 2)
            answers = [
                _answer(discover_effects(joined_datasets(again, [further])), term.name) for further in (proposed, more)
            ]
            result = _result(found, key, term.name)
            yield result.model_copy(update={"proposed": answers[0], "recorded": answers[1]})


def discovered_with_models(dataset: Dataset) -> tuple[Discovery, CompetingModels]:
    """What is discovered, and the models that the recordings cannot tell apart."""
    kept: list[CompetingModels] = []
    compete = confirming.competing_models

    def keeping(*arguments: Any) -> CompetingModels:
        kept.append(compete(*arguments))
        return kept[-1]

    confirming.competing_models = keeping
    try:
        return discover_effects(dataset), kept[-1]
    finally:
        confirming.competing_models = compete


def _part(dataset: Dataset, minutes: float, seed: int) -> Dataset:
    """Some of the runs of a data set, at random, that take so long, as a session of their own."""
    order = np.random.default_rng(seed).permutation(len(dataset.trajectories))
    runs = [dataset.trajectories[index] for index in order]
    ends = np.cumsum([run.times[-1] + 15.0 for run in runs])
    kept = [
        replace(run, session="further", id=f"further-{run.id}")
        for run in runs[: max(int((ends <= 60 * minutes).sum()), 1)]
    ]
    return replace(dataset, name="further", trajectories=tuple(kept))


def _result(found: Discovery, key: str, truth: str) -> Result:
    result = Result(key=key, truth=truth, verdict=found.verdict)
    if len(found.experiments) != 1:
        return result
    (experiment,) = found.experiments
    return result.model_copy(
        update={
            "names": experiment.separates,
            "runs": experiment.runs,
            "minutes": experiment.minutes,
            "chance": experiment.chance,
            "chance_recorded": experiment.chance_recorded,
            "inseparable": experiment.inseparable,
        }
    )


def _answer(found: Discovery, truth: str) -> Answer:
    names: tuple[NamedEffect, ...] = found.effects
    weight = next((effect.weight for effect in names[:1] if effect.name == truth), 0.0)
    return Answer(verdict=found.verdict, names=tuple(effect.name for effect in names), weight=weight)


def print_table(results: Sequence[Result]) -> None:
    """How often the right name is sure after the proposed runs, beside what was promised."""
    judged = [each for each in results if each.proposed is not None and each.recorded is not None]
    print(f"\n{len(results)} sets, of which {len(judged)} ended in a class with its truth and a proposal")
    groups: dict[tuple[str, str], list[Result]] = {}
    for each in judged:
        part = (("omni3" if each.key.startswith("omni3") else "flower"), each.truth)
        groups.setdefault(part, []).append(each)
    groups |= {("all", ""): judged}
    print(
        f"{'set':9}{'truth':32}{'sets':>5}{'minutes':>9}{'promised':>10}{'sure':>22}{'wrong':>7}{'recorded again':>22}"
    )
    for (kind, truth), members in groups.items():
        if not members:
            continue
        proposed = [each.proposed for each in members if each.proposed is not None]
        again = [each.recorded for each in members if each.recorded is not None]
        minutes, chance = np.median([each.minutes for each in members]), np.mean([each.chance for each in members])
        chance_again = np.mean([each.chance_recorded for each in members])
        sure, wrong = _rate([each.sure for each in proposed]), sum(each.wrong for each in proposed)
        sure_again = f"{chance_again:.0%}, {np.mean([each.sure for each in again]):.0%} sure"
        print(f"{kind:9}{truth:32}{len(members):5}{minutes:9.1f}{chance:10.0%}{sure:>22}{wrong:7}{sure_again:>22}")


def _rate(hits: Sequence[bool]) -> str:
    """A share of hits with the 95 % interval of Wilson."""
    interval = binomtest(sum(hits), len(hits)).proportion_ci(0.95, "wilson")
    return f"{np.mean(hits):.0%} ({interval.low:.0%} to {interval.high:.0%})"


def _hidden(arguments: argparse.Namespace, done: set[str]) -> Iterator[Result]:
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        for level in arguments.levels:
            for name in arguments.only or EFFECTS:
                if (key := f"{name} {level:g} {seed}") not in done:
                    yield hidden_set(name, level, seed, key)


def _omni3(arguments: argparse.Namespace, done: set[str]) -> Iterator[Result]:
    dataset = import_dataset("optiodom", arguments.omni3)
    yield from omni3_sets(dataset, range(arguments.first_seed, arguments.first_seed + arguments.seeds), done)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of results, one line of JSON a set")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="an effect; default: all")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--levels", type=float, nargs="+", default=list(LEVELS))
    parser.add_argument("--omni3", type=Path, metavar="FOLDER", help="omni3's recordings, in the place of hidden sets")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    return parser.parse_args()


if __name__ == "__main__":
    main()
