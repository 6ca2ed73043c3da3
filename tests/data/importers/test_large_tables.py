"""Tables that go through a temporary file give what they give in memory, and leave nothing behind."""

import gc
import pickle
import signal
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from drive_samples import DIFF, drive

import omnibench.data.delimited as delimited
from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.slam.import_dataset import import_dataset

TICKS = {"wheel_unit": "ticks", "ticks_per_turn": 4096}


def counted(seed: int) -> pl.DataFrame:
    """Ticks that begin again after 65536, at 50 Hz, and poses in some of the rows."""
    of = drive(seed, noise=0.0)
    steps = np.diff(of.times, prepend=0.0)[:, None]
    ticks = np.round(np.cumsum(of.rates * steps, axis=0) * 4096 / (2 * np.pi)) % 65536
    at = np.arange(0, len(of.times), 5)
    frame = pl.DataFrame({"t": of.times, "ticks_left": ticks[:, 0], "ticks_right": ticks[:, 1]})
    columns = {}
    for name, values in zip(("x", "y", "theta"), of.poses.T, strict=True):
        shown = np.full(len(of.times), np.nan)
        shown[at] = np.interp(of.times[at], of.pose_times, values)
        columns[name] = pl.Series(shown).fill_nan(None)
    return frame.with_columns(**columns)


def runs() -> pl.DataFrame:
    """A table of four runs, whose rows follow one another."""
    return pl.concat([counted(seed).with_columns(run=pl.lit(f"curve_{seed}")) for seed in (1, 2, 3, 4)])


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files, through which every table goes."""
    (folder := tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def streamed(monkeypatch: pytest.MonkeyPatch, source: Path, options: dict[str, Any]) -> Dataset:
    monkeypatch.setattr(delimited, "LARGE", 0)
    return import_dataset("csv", source, {"robot": DIFF} | options)


def one_table(folder: Path) -> None:
    runs().write_csv(folder / "log.csv")


def mixed_rows(folder: Path) -> None:
    runs().sort("t", maintain_order=True).write_csv(folder / "log.csv")


def two_files_a_run(folder: Path) -> None:
    for seed in (1, 2, 3):
        rows = counted(seed)
        rows.select("t", "ticks_left", "ticks_right").write_csv(folder / f"day/{seed}_wheels.csv", separator=";")
        rows.select("t", "x", "y", "theta").drop_nulls().write_csv(folder / f"day/{seed}_poses.csv")


def one_text_with_comments(folder: Path) -> None:
    rows = counted(1).drop_nulls()
    lines = ["# by hand", "", rows.write_csv(separator=" ").strip().replace("\n", "  # row\n\n")]
    (folder / "log.txt").write_text("\n".join(lines))


def one_parquet_file(folder: Path) -> None:
    runs().write_parquet(folder / "log.parquet")


@pytest.mark.parametrize(
    ("write", "options"),
    [
        (one_table, {}),
        (one_table, {"window": 4.0, "jumps": "drop", "validation": "*_4*"}),
        (one_table, {"clocks": "match"}),
        (mixed_rows, {}),
        (two_files_a_run, {}),
        (one_text_with_comments, {"separator": "blanks", "header_lines": 1}),
        (one_parquet_file, {}),
    ],
    ids=lambda value: value.__name__ if callable(value) else " ".join(value),
)
def test_a_large_table_is_imported_as_it_is_in_memory(
    write: Any, options: dict[str, Any], tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "log" / "day").mkdir(parents=True)
    write(tmp_path / "log")
    held = import_dataset("csv", tmp_path / "log", {"robot": DIFF} | TICKS | options)
    large = streamed(monkeypatch, tmp_path / "log", TICKS | options)
    assert held.trajectories[0].samples.held
    assert not any(run.samples.held for run in large.trajectories)
    assert (large.hash, large.warnings, large.sample_period) == (held.hash, held.warnings, held.sample_period)
    assert [run.id for run in large.trajectories] == [run.id for run in held.trajectories]
    for table_format in ("parquet", "csv"):
        save_dataset(large, tmp_path / "saved", table_format)
        assert load_dataset(tmp_path / "saved").hash == held.hash
    assert len(pickle.loads(pickle.dumps(large)).trajectories[0].times)
    del large
    gc.collect()
    assert not list(temporary.iterdir())


def test_a_flaw_far_below_is_named_by_its_row(tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = runs().write_csv().splitlines()
    for line, words in (
        (lines[1500].replace(",", ",x", 1), "is 'x"),
        (f"{lines[1500]},1", "it has 8 fields, expected 7"),
    ):
        (tmp_path / "log.csv").write_text("\n".join([*lines[:1500], line, *lines[1501:]]))
        with pytest.raises(DataError, match=rf"log.csv, row \d+ \(line 1501\): .*{words}"):
            streamed(monkeypatch, tmp_path / "log.csv", TICKS)
    gc.collect()
    assert not list(temporary.iterdir())


def test_a_break_while_a_large_table_is_read_or_written_leaves_nothing_half_written(
    tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_table(tmp_path)
    data = streamed(monkeypatch, tmp_path / "log.csv", TICKS)

    def broken(*_: Any, **__: Any) -> Any:
        signal.raise_signal(signal.SIGINT)

    save_dataset(data, tmp_path / "saved")
    with monkeypatch.context() as patched:
        patched.setattr("omnibench.data.runs.cut_into_runs", broken)
        with pytest.raises(KeyboardInterrupt):
            streamed(monkeypatch, tmp_path / "log.csv", TICKS)
    with monkeypatch.context() as patched:
        patched.setattr("omnibench.files.Path.replace", broken, raising=False)
        with pytest.raises(KeyboardInterrupt):
            save_dataset(data, tmp_path / "saved")
    assert load_dataset(tmp_path / "saved").hash == data.hash
    assert sorted(file.name for file in (tmp_path / "saved").iterdir()) == [
        "dataset.yaml", "poses.parquet", "trajectories.parquet", "wheels.parquet",
    ]  # fmt: skip
    del data
    gc.collect()
    assert not list(temporary.iterdir())


def test_a_data_set_whose_temporary_file_is_gone_says_so(
    tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_table(tmp_path)
    data = streamed(monkeypatch, tmp_path / "log.csv", TICKS)
    run = pickle.loads(pickle.dumps(data.trajectories[0]))
    for file in temporary.iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"cannot be read: .*save the data set"):
        _ = run.times
