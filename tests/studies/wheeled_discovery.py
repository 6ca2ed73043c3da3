"""Discovery on robots of every class: how often the hidden effect is named, and what it says of real recordings.

    python tests/studies/wheeled_discovery.py --seeds 3 [--cases play lag] [--real]

Prints a line for each case and seed: verdict, names, weights and estimates; with --real for OptiOdom's tricycle and
differential drive as a whole.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "discover")]

from real_recordings import OPTIODOM  # noqa: E402
from test_discovering import HIDDEN, recordings  # noqa: E402

from omnibench.data.dataset import Dataset  # noqa: E402
from omnibench.discover.discover import discover_effects  # noqa: E402
from omnibench.slam.import_dataset import import_dataset  # noqa: E402


def report(label: str, dataset: Dataset) -> None:
    """Print what is discovered."""
    began = time.monotonic()
    found = discover_effects(dataset)
    names = [
        f"{each.name} {each.weight:.3f} ({', '.join(f'{p.name} {p.value:.4g}' for p in each.parameters)})"
        for each in found.effects
    ]
    where = ", ".join(dict.fromkeys(each.covariate for each in found.where))
    print(f"{label}: {found.verdict}; {'; '.join(names) or 'nothing'}; over {where or 'nothing'}; "
          f"{time.monotonic() - began:.0f} s", flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--cases", nargs="*", default=[""])
    parser.add_argument("--real", action="store_true")
    chosen = parser.parse_args()
    for case in HIDDEN:
        if any(word in case for word in chosen.cases):
            robot, name, parameters, commands, _ = HIDDEN[case]
            for seed in range(1, chosen.seeds + 1):
                hidden = [{"name": name, "parameters": parameters}]
                report(f"{case} {parameters}, seed {seed}", recordings(robot, hidden, commands, seed=seed))
    if chosen.real:
        for robot in ("tricyc", "diff"):
            report(robot, import_dataset("optiodom", OPTIODOM / robot))


if __name__ == "__main__":
    main()
