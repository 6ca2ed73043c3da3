"""Verdicts of discover on a robot that is simulated from command to SLAM, without any hidden effect.

    python tests/studies/chain_study.py --seeds 3 --variants plain latency coarse

Every set prints a JSON row: the verdict, the names with their values, where the odometry fails, and how good SLAM was.
A name is an artefact of the chain (motors that follow late, the reference's latency) or it is false.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omnibench import discover_effects
from omnibench.discover.result import Discovery
from omnibench.simulate.config import RobotConfig
from omnibench.simulate.source import read_simulation, simulate_dataset
from omnibench.slam.slam_dataset import slam_accuracy

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "apr02_robot.yaml"
ARTEFACTS = frozenset({"motor_lag", "motor_gain", "motor_dead_band", "reference_time_offset"})
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "latency": {"lidar": {"latency": 0.03}},
    "coarse": {"encoder": {"ticks": 3200}},
    "jerk": {"profile": {"shape": "jerk_limited"}},
    "hall": {"room": {"plan": "hall"}},
}


def config_of(variant: str, seed: int, **changes: Any) -> RobotConfig:
    """The paper's experiment, its training session only, changed."""
    given = read_simulation(CONFIG).config
    assert isinstance(given, RobotConfig)
    train = {"seed": seed, "distance": given.train.distance}
    content = given.model_dump(exclude={"validation"}) | {"train": train} | VARIANTS[variant] | changes
    return RobotConfig.model_validate(content)


def false_names(found: Discovery) -> list[str]:
    """Names of effects that are not there."""
    return [effect.name for effect in found.effects if effect.name not in ARTEFACTS]


def rows(variants: list[str], seeds: int) -> Iterator[dict[str, Any]]:
    """One for every set."""
    for seed in range(1, seeds + 1):
        for variant in variants:
            began = time.monotonic()
            made = simulate_dataset(config_of(variant, seed), variant)
            found = discover_effects(made.dataset)
            yield {
                "variant": variant,
                "seed": seed,
                "verdict": found.verdict,
                "names": {
                    each.name: {own.name: (own.value, own.low, own.high) for own in each.parameters}
                    for each in found.effects
                },
                "false": false_names(found),
                "left": [
                    (each.covariate, each.p_value, each.within_ticks) for each in found.left if each.stage != "actuator"
                ],
                "slam_mm": 1e3 * slam_accuracy(made.dataset, made.paths).final.position_mean_m,
                "seconds": time.monotonic() - began,
            }


def main() -> None:
    """Print the rows as they come."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    chosen = parser.parse_args()
    for row in rows(chosen.variants, chosen.seeds):
        print(json.dumps(row))
        sys.stdout.flush()


if __name__ == "__main__":
    main()
