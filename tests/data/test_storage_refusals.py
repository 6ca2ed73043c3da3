"""Data sets on disk that cannot be right are refused in one line that names file, row and reason."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest
from storage_samples import (
    FORMATS,
    Change,
    Format,
    drop_column,
    drop_rows,
    header,
    overwrite,
    remove_file,
    rename,
    set_cell,
    with_frame,
)

from omnibench.data.storage import load_dataset
from omnibench.errors import DataError

REFUSED: dict[str, tuple[Change, str, str]] = {
    "a wheel column is missing": (
        rename("wheels", "omega_b", "omega_bb"),
        "wheels.{x}: ",
        "column 'omega_b' is missing; did you mean 'omega_bb'? found: trajectory, t, omega_a",
    ),
    "a time column is missing": (drop_column("wheels", "t"), "wheels.{x}: ", "column 't' is missing"),
    "a pose column is missing": (rename("poses", "theta", "thetaa"), "poses.{x}: ", "did you mean 'thetaa'?"),
    "the ids are missing": (drop_column("poses", "trajectory"), "poses.{x}: ", "column 'trajectory' is missing"),
    "the split is missing": (drop_column("trajectories", "split"), "trajectories.{x}: ", "column 'split' is missing"),
    "one of the wheel angles is missing": (
        drop_column("wheels", "phi_b"),
        "wheels.{x}: ",
        "column 'phi_b' is missing; give all of phi_a, phi_b, phi_c or none",
    ),
    "one of the covariances is missing": (drop_column("poses", "cov_yy"), "poses.{x}: ", "column 'cov_yy' is missing"),
    "a rate is NaN": (set_cell("wheels", 6, "omega_c", math.nan), "wheels.{x}, row 6: ", "omega_c is nan"),
    "a rate is infinite": (set_cell("wheels", 2, "omega_a", math.inf), "wheels.{x}, row 2: ", "omega_a is inf"),
    "a rate is empty": (set_cell("wheels", 3, "omega_b", None), "wheels.{x}, row 3: ", "omega_b is missing"),
    "a wheel angle is NaN": (set_cell("wheels", 1, "phi_a", math.nan), "wheels.{x}, row 1: ", "phi_a is nan"),
    "a target is infinite": (set_cell("wheels", 8, "target_c", -math.inf), "wheels.{x}, row 8: ", "target_c is -inf"),
    "a time is NaN": (set_cell("wheels", 4, "t", math.nan), "wheels.{x}, row 4: ", "t is nan"),
    "a pose is NaN": (set_cell("poses", 5, "theta", math.nan), "poses.{x}, row 5: ", "theta is nan"),
    "a pose is infinite": (set_cell("poses", 1, "x", -math.inf), "poses.{x}, row 1: ", "x is -inf"),
    "a covariance is NaN": (set_cell("poses", 2, "cov_xy", math.nan), "poses.{x}, row 2: ", "cov_xy is nan"),
    "a pose's time is infinite": (set_cell("poses", 6, "t", math.inf), "poses.{x}, row 6: ", "t is inf"),
    "a commanded speed is infinite": (
        set_cell("trajectories", 2, "v", math.inf),
        "trajectories.{x}, row 2: ",
        "v is inf; leave it empty",
    ),
    "a start time is NaN": (set_cell("trajectories", 1, "started_at", math.nan), "trajectories.{x}, row 1: ", "is nan"),
    "half a repetition": (
        set_cell("trajectories", 1, "repetition", 1.5),
        "trajectories.{x}, row 1: ",
        "repetition is 1.5",
    ),
    "time goes backwards": (
        set_cell("wheels", 7, "t", 0.15),
        "wheels.{x}, row 7: ",
        "t goes backwards: 0.15 after 0.2",
    ),
    "a time is repeated": (set_cell("wheels", 2, "t", 0.1), "wheels.{x}, row 2: ", "t is repeated: 0.1 after 0.1"),
    "a pose's time goes backwards": (set_cell("poses", 6, "t", 0.1), "poses.{x}, row 6: ", "t goes backwards"),
    "a pose's time is repeated": (set_cell("poses", 3, "t", 0.2), "poses.{x}, row 3: ", "t is repeated"),
    "a wheel row at t = 0": (set_cell("wheels", 1, "t", 0.0), "wheels.{x}, row 1: ", "wheel samples start after t = 0"),
    "a wheel row before t = 0": (set_cell("wheels", 5, "t", -0.1), "wheels.{x}, row 5: ", "t is -0.1"),
    "a pose before t = 0": (set_cell("poses", 4, "t", -0.1), "poses.{x}, row 4: ", "t is -0.1"),
    "no pose at t = 0": (set_cell("poses", 4, "t", 0.05), "poses.{x}, row 4: ", "run-2 has no reference pose at t = 0"),
    "no pose after t = 0": (
        drop_rows("poses", 5, 6),
        "poses.{x}, row 4: ",
        "run-2 has no reference pose after its start",
    ),
    "a run without poses": (
        drop_rows("poses", 4, 5, 6),
        "poses.{x}: ",
        "trajectory run-2 (trajectories.{x}, row 2) has no reference poses",
    ),
    "a run without wheels": (
        drop_rows("wheels", 1, 2, 3, 4),
        "wheels.{x}: ",
        "trajectory run-1 (trajectories.{x}, row 1) has no wheel samples",
    ),
    "an id twice": (
        set_cell("trajectories", 2, "trajectory", "run-1"),
        "trajectories.{x}, row 2: ",
        "trajectory run-1 is there twice",
    ),
    "an empty id": (set_cell("poses", 2, "trajectory", None), "poses.{x}, row 2: ", "trajectory is missing"),
    "an unknown split": (
        set_cell("trajectories", 2, "split", "validate"),
        "trajectories.{x}, row 2: ",
        "split is 'validate'; did you mean 'validation'?",
    ),
    "an empty split": (set_cell("trajectories", 1, "split", None), "trajectories.{x}, row 1: ", "split is None"),
    "wheels of an unknown run": (
        set_cell("wheels", 5, "trajectory", "run-3"),
        "wheels.{x}, row 5: ",
        "trajectory run-3 is not in trajectories.{x}",
    ),
    "poses of an unknown run": (
        set_cell("poses", 3, "trajectory", "x"),
        "poses.{x}, row 3: ",
        "trajectory x is not in",
    ),
    "text among rates": (
        set_cell("wheels", 6, "omega_b", "fast"),
        "wheels.{x}, row 6: ",
        "omega_b is 'fast', expected a number",
    ),
    "text among poses": (set_cell("poses", 2, "x", "1,5"), "poses.{x}, row 2: ", "x is '1,5', expected a number"),
    "text among commands": (
        set_cell("trajectories", 2, "omega", "left"),
        "trajectories.{x}, row 2: ",
        "omega is 'left', expected a number",
    ),
    "no wheels table": (remove_file("wheels"), ": ", "wheels.parquet (or wheels.csv) is missing"),
    "no poses table": (remove_file("poses"), ": ", "poses.parquet (or poses.csv) is missing"),
    "no trajectories table": (
        remove_file("trajectories"),
        ": ",
        "trajectories.parquet (or trajectories.csv) is missing",
    ),
    "an empty wheels table": (with_frame("wheels", lambda frame: frame.clear()), "wheels.{x}: ", "it has no rows"),
    "an empty table of runs": (
        with_frame("trajectories", lambda frame: frame.clear()),
        "trajectories.{x}: ",
        "it has no rows",
    ),
    "a file of nothing": (overwrite("poses", b""), "poses.{x}: ", "cannot be read"),
    "a file that is no table": (overwrite("poses", b"\x89PNG\xff\xfe\x00"), "poses.{x}: ", ""),
    "no header": (lambda folder: (folder / "dataset.yaml").unlink(), "dataset.yaml: ", "no such file"),
    "a header that is no YAML": (
        lambda folder: (folder / "dataset.yaml").write_text("a: [1"),
        "dataset.yaml: ",
        "YAML",
    ),
    "another format": (
        header("format", "omnibench-dataset/9"),
        "dataset.yaml: ",
        "format is 'omnibench-dataset/9', expected 'omnibench-dataset/1'",
    ),
    "no format": (header("format", None), "dataset.yaml: ", "format is None"),
    "no robot": (header("robot", None), "dataset.yaml: ", "key 'robot' is missing"),
    "a misspelt key": (header("sample_perod", 0.1), "dataset.yaml: ", "did you mean 'sample_period'?"),
    "a period of zero": (header("sample_period", 0), "dataset.yaml: ", "sample_period"),
    "other wheels than the robot's": (
        header("wheels", ["a", "b", "d"]),
        "dataset.yaml: ",
        "wheels are a, b, d, but the robot's wheels with a measured rate are a, b, c;",
    ),
    "wheels in another order": (header("wheels", ["c", "b", "a"]), "dataset.yaml: ", "the same order"),
}


@pytest.mark.parametrize("most_in_memory", [100, 0], ids=["in memory", "in its file"])
@pytest.mark.parametrize("fmt", FORMATS)
@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line_that_names_file_row_and_reason(
    good: dict[Format, Path], tmp_path: Path, case: str, fmt: Format, most_in_memory: int
) -> None:
    change, place, reason = REFUSED[case]
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    change(folder)
    with pytest.raises(DataError) as refusal:
        load_dataset(folder, most_in_memory=most_in_memory)
    message = str(refusal.value)
    separator = "" if place.startswith(":") else "/"
    assert message.startswith(f"{folder}{separator}{place.format(x=fmt)}")
    assert reason.format(x=fmt) in message
    assert "\n" not in message
