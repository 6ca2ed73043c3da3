"""Calibration intervals of single sessions of a real robot against the spread between sessions.

    python tests/studies/session_spread.py DATASET      # for example omni3, imported: its training split

Each session of the training split is left out in turn: the matrix of the others is compared with that of all. The
scatter of these answers (the jackknife over sessions) is what a calibration made on other days would move by, and is
put beside the standard deviations that calibrations state.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset
from omnibench.fit.calibrate import calibrate

CALIBRATORS = {"closed_form": {}, "trajectory_ml": {"clock": "offset_and_slope"}}


def without(dataset: Dataset, session: str) -> Dataset:
    """The training runs of the other sessions."""
    kept = tuple(run for run in dataset.split("train") if run.session != session)
    return replace(dataset, trajectories=kept)


def main() -> None:
    """A table for each calibrator."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    dataset = load_dataset(parser.parse_args().dataset)
    sessions = sorted({run.session for run in dataset.split("train") if run.session is not None})
    for name, options in CALIBRATORS.items():
        whole = calibrate(dataset, name, options=options)
        others = np.array([calibrate(without(dataset, s), name, options=options).result.matrix for s in sessions])
        count = len(sessions)
        jackknife = np.sqrt((count - 1) / count * np.square(others - others.mean(axis=0)).sum(axis=0))
        assert whole.uncertainty is not None, whole.warnings
        stated = whole.uncertainty.standard_deviations
        size = np.abs(dataset.robot.inverse_kinematic_matrix).max(axis=1, keepdims=True)
        print(f"{dataset.name}, {name}, {count} sessions; {whole.uncertainty.source}; {whole.result.reason}")
        print("standard deviations, % of the row's largest element: stated / jackknife over sessions")
        for row, mine, theirs in zip("xyw", 100 * stated / size, 100 * jackknife / size, strict=True):
            print(f"  {row}  " + "   ".join(f"{a:5.2f} / {b:5.2f}" for a, b in zip(mine, theirs, strict=True)))
        ratio = np.sqrt(np.mean(np.square(stated / size)) / np.mean(np.square(jackknife / size)))
        print(f"  stated / jackknife, all elements: {ratio:.2f}\n")


if __name__ == "__main__":
    main()
