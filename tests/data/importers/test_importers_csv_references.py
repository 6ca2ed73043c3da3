"""Distances, turns, positions and headings in tables beside those of the wheels, in the place of poses or with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drive_samples import DIFF

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.importers.csv_tables.csv import Csv
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.csv_template import write_template
from omnibench.data.importers.dataset_folder import DatasetFolder, DatasetOptions
from omnibench.data.importers.runs.recording_runs import in_seconds
from omnibench.data.storage import save_dataset
from omnibench.errors import DataError

TAPE = "kind,value,sigma\ndistance,1.01,0.003\n"


def wheels(zero: float = 0.0, rates: tuple[float, float] = (4.0, 4.0)) -> str:
    """Five seconds of wheels at 20 Hz from a time on, s."""
    rows = [f"{zero + 0.05 * k:.3f},{rates[0]},{rates[1]}" for k in range(1, 101)]
    return "\n".join(["t,omega_left,omega_right", *rows]) + "\n"


def write(folder: Path, **tables: str) -> Path:
    """A folder with tables by their names without .csv."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


def read(source: Path, **options: Any) -> Dataset:
    return Csv(CsvOptions(robot=DIFF, **options)).read(source)


def the_run(source: Path, **options: Any) -> Trajectory:
    (run,) = read(source, **options).trajectories
    return run


def measured(run: Trajectory) -> list[tuple[str, float, float, float]]:
    """Kind, t0, t1 and first value of each reference of a run."""
    assert run.references is not None
    its = run.references
    return list(zip(its.kinds.tolist(), its.t0.tolist(), its.t1.tolist(), its.values[:, 0].tolist(), strict=True))


def test_a_run_with_references_needs_no_poses_and_one_table_holds_those_of_all_runs(tmp_path: Path) -> None:
    run = the_run(write(tmp_path / "one", a_wheels=wheels(), a_references=TAPE))
    assert not run.has_poses
    assert measured(run) == [("distance", 0.0, 5.0, 1.01)]
    table = "run,kind,value,sigma\nb,turn,3.1,0.01\na,distance,1.0,0.003\nb,turn,3.2,0.01\n"
    source = write(tmp_path / "all", a_wheels=wheels(), b_wheels=wheels(0.0, (-2, 2)), references=table)
    runs = read(source).trajectories
    assert [[kind for kind, *_ in measured(run)] for run in runs] == [["distance"], ["turn", "turn"]]


def test_references_may_stand_beside_one_table_of_the_wheels_of_all_runs(tmp_path: Path) -> None:
    header, *rows = wheels().splitlines()
    table = "\n".join([f"run,{header}", *(f"{run},{row}" for run in "ab" for row in rows)])
    told = "run,kind,value,sigma\na,distance,1.0,0.003\nb,distance,1.1,0.003\n"
    runs = read(write(tmp_path, log=table, references=told)).trajectories
    assert [(run.id, measured(run)[0][3]) for run in runs] == [("a", 1.0), ("b", 1.1)]


def test_references_that_do_not_name_their_run_are_not_taken_for_those_of_every_run(tmp_path: Path) -> None:
    header, *rows = wheels().splitlines()
    table = "\n".join([f"Lauf,{header}", *(f"{run},{row}" for run in "ab" for row in rows)])
    told = "Name,Kind,Value,Sigma\na,distance,1.0,0.003\nb,distance,1.1,0.003\n"
    source = write(tmp_path, log=table, references=told)
    with pytest.raises(DataError, match=r"references\.csv: column 'Lauf' is missing; .* --set run_column=NAME"):
        read(source, run_column="Lauf")
    write(tmp_path, log=table.replace("Lauf,", "run,"))
    with pytest.raises(DataError, match=r"references\.csv: column 'run' is missing, .*; --set run_column=NAME"):
        read(source)
    runs = read(write(tmp_path, references=told.replace("Name", "Run"))).trajectories
    assert [measured(run)[0][3] for run in runs] == [1.0, 1.1]


def test_some_runs_have_poses_and_others_references(tmp_path: Path) -> None:
    poses = "t,x,y,theta\n0,0,0,0\n2.5,0.5,0.001,0\n5,1.001,0,0.001\n"
    source = write(tmp_path, a_wheels=wheels(), a_poses=poses, b_wheels=wheels(), b_references=TAPE)
    posed, taped = read(source).trajectories
    assert (posed.has_poses, posed.references) == (True, None)
    assert (taped.has_poses, len(measured(taped))) == (False, 1)


def test_references_are_read_in_the_units_and_senses_of_the_options(tmp_path: Path) -> None:
    table = (
        "kind,t1,value,value_x,value_y,sigma\ndistance,,1010,,,3\nturn,,90,,,1\n"
        "position,2,,1000,500,20\nheading,3,10,,,2\n"
    )
    options = {"position_unit": "mm", "heading_unit": "deg", "pose_signs": (1, -1, -1), "heading_offset_deg": 90}
    references = the_run(write(tmp_path, a_wheels=wheels(), a_references=table), **options).references
    values = dict(zip(references.kinds.tolist(), references.values.tolist(), strict=True))
    assert values["distance"][0] == pytest.approx(1.01)
    assert values["turn"][0] == pytest.approx(-np.pi / 2)
    assert values["position"] == pytest.approx([1.0, -0.5])
    assert values["heading"][0] == pytest.approx(np.radians(80))
    sigmas = dict(zip(references.kinds.tolist(), references.sigmas[:, 0].tolist(), strict=True))
    assert sigmas == pytest.approx(
        {"distance": 0.003, "turn": np.radians(1), "position": 0.02, "heading": np.radians(2)}
    )


def test_times_of_references_are_by_the_clock_of_the_recording(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,value_x,value_y,sigma\nposition,,1700000002500,,0.5,0,0.02\n"
    table += "turn,1700000001000,1700000003000,0.0,,,0.01\n"
    source = write(tmp_path, a_wheels=wheels(1_700_000_000.0), a_references=table)
    run = the_run(source, pose_time_unit="ms", pose_time_offset=0.5)
    assert [(kind, pytest.approx(t0), pytest.approx(t1)) for kind, t0, t1, _ in measured(run)] == [
        ("position", 3.0, 3.0),
        ("turn", 1.5, 3.5),
    ]


def test_a_heading_from_zero_on_counts_from_the_start_of_the_run(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,sigma\nheading,0,12,0.1,0.05\nheading,,13,0.2,0.05\n"
    run = the_run(write(tmp_path, a_wheels=wheels(10.0), a_references=table))
    assert [each[:2] for each in measured(run)] == [("heading", 0.0), ("heading", pytest.approx(3.0))]


def test_a_pose_at_the_start_alone_makes_the_frame_of_positions_known(tmp_path: Path) -> None:
    table = "kind,t1,value_x,value_y,sigma\nposition,5,3,4,0.01\n"
    source = write(tmp_path, a_wheels=wheels(), a_references=table, a_poses="t,x,y,theta\n0,2,4,0\n")
    run = the_run(source)
    assert run.start_known
    assert run.start.tolist() == [2.0, 4.0, 0.0]


def test_references_outside_of_the_wheels_are_left_out_and_said(tmp_path: Path) -> None:
    table = "kind,t1,value_x,value_y,sigma\nposition,2,0.4,0,0.01\nposition,9,1,0,0.01\n"
    dataset = read(write(tmp_path, a_wheels=wheels(), a_references=table))
    assert len(measured(dataset.trajectories[0])) == 1
    assert any("1 of 2 references left out" in warning for warning in dataset.warnings)


def test_a_recording_cut_into_windows_keeps_the_references_within_each(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,sigma\ndistance,0.5,2,0.3,0.003\ndistance,3,4.5,0.3,0.003\ndistance,,,1,0.003\n"
    runs = read(write(tmp_path, a_wheels=wheels(), a_references=table), window=2.5).trajectories
    assert [measured(run) for run in runs] == [
        [("distance", 0.5, 2.0, 0.3)],
        [("distance", pytest.approx(0.5), pytest.approx(2.0), 0.3)],
    ]


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"a_references": "kind,value,sigma\ndistnace,1,0.1\n"}, r"row 1 \(line 2\): .*did you mean 'distance'"),
        ({"a_references": "kind,value\ndistance,1\n"}, "sigma is missing"),
        ({"a_references": "value,sigma\n1,0.1\n"}, "column 'kind' is missing"),
        ({"a_references": "kind,t1,value,sigma\nheading,90,1,0.1\n"}, "none of its references lies within"),
        ({"references": "run,kind,value,sigma\nb,distance,1,0.1\n"}, "run 'a' is not in its column run"),
        ({"references": "run,kind,value,sigma\na,turn,1,0.1\nab,turn,1,0.1\n"}, "'ab' has no wheels; did you mean 'a'"),
        ({"references": TAPE, "b_wheels": wheels()}, "column 'run' is missing"),
        ({"b_references": TAPE}, "run 'a' has no a_poses.csv"),
        ({"a_references": TAPE, "b_references": TAPE}, "run 'b' has no b_wheels.csv"),
    ],
)
def test_what_is_wrong_with_references_is_said_in_one_line(tmp_path: Path, tables: dict[str, str], words: str) -> None:
    source = write(tmp_path, a_wheels=wheels(), **tables)
    with pytest.raises(DataError, match=words) as refusal:
        read(source)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("robot_type", ["diff", "omni3", "swerve"])
def test_the_template_with_references_imports_as_it_is_written(tmp_path: Path, robot_type: str) -> None:
    write_template(tmp_path / "log", robot_type, references=True)
    dataset = Csv(CsvOptions.model_validate(Csv.completed({}, tmp_path / "log"))).read(tmp_path / "log")
    assert dataset.warnings == ()
    kinds = {kind for run in dataset.trajectories for kind, *_ in measured(run)}
    assert {"distance", "turn"} <= kinds
    assert not any(run.has_poses for run in dataset.trajectories)


def reread(folder: Path, **options: Any) -> Dataset:
    """A data set on disk by the importer ``dataset``."""
    return DatasetFolder(DatasetOptions.model_validate(DatasetFolder.completed(options, folder))).read(folder)


def test_the_importer_of_data_sets_keeps_references_to_the_bit(tmp_path: Path) -> None:
    write_template(tmp_path / "log", "omni3", references=True)
    dataset = Csv(CsvOptions.model_validate(Csv.completed({}, tmp_path / "log"))).read(tmp_path / "log")
    save_dataset(dataset, tmp_path / "old")
    assert reread(tmp_path / "old").hash == dataset.hash
    cut = reread(tmp_path / "old", jumps="cut", start_at_rest=True, clocks="match", pose_time_offset=0.1)
    assert [len(measured(run)) for run in cut.trajectories] == [1] * 10


def test_a_data_set_read_in_other_units_has_its_references_in_them_too(tmp_path: Path) -> None:
    source = write(tmp_path / "log", a_wheels=wheels(), a_references="kind,value,sigma\ndistance,1010,3\n")
    assert any("--set position_unit=mm" in warning for warning in read(source).warnings)
    save_dataset(read(source), tmp_path / "old")
    (run,) = reread(tmp_path / "old", position_unit="mm").trajectories
    assert measured(run) == [("distance", 0.0, 5.0, pytest.approx(1.01))]


def test_a_run_of_a_data_set_that_is_cut_keeps_the_references_of_each_part(tmp_path: Path) -> None:
    with_gap = "\n".join(line for line in wheels().splitlines() if not line.startswith(("2.1", "2.2", "2.3"))) + "\n"
    table = "kind,t0,t1,value,sigma\ndistance,0.5,2,0.3,0.003\ndistance,3,4.5,0.3,0.003\ndistance,,,1,0.003\n"
    save_dataset(read(write(tmp_path / "log", a_wheels=with_gap, a_references=table)), tmp_path / "old")
    runs = reread(tmp_path / "old", longest_gap=0.2).trajectories
    assert [(run.id, len(measured(run))) for run in runs] == [("a#1", 1), ("a#2", 1)]


def test_a_data_set_with_times_in_ms_has_its_references_in_seconds_too(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,sigma\ndistance,500,2000,0.3,0.003\ndistance,,,1,0.003\n"
    rows = [f"{0.05 * k:.3f},4,4" for k in range(1, 101)]
    source = write(tmp_path / "log", a_wheels="\n".join(["t,omega_left,omega_right", *rows]), a_references=table)
    run = the_run(source, pose_time_unit="ms")
    slow = replace(run, references=replace(run.references, t0=run.references.t0 * 1e3, t1=run.references.t1 * 1e3))
    mended = in_seconds(replace(slow, times=run.times * 1e3), 1e-3, 1e-3)
    assert measured(mended) == [(kind, pytest.approx(t0), pytest.approx(t1), v) for kind, t0, t1, v in measured(run)]
