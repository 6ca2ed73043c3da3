"""The folder that a command writes results to."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnibench.errors import DataError
from omnibench.results_folder import check_folder, link_latest, new_folder


def test_folders_made_in_the_same_second_have_names_of_their_own(tmp_path: Path) -> None:
    folders = [new_folder(tmp_path / "data") for _ in range(4)]
    assert len(set(folders)) == 4
    assert all(folder.is_dir() for folder in folders)


def test_the_link_points_to_the_newest(tmp_path: Path) -> None:
    for _ in range(2):
        newest = new_folder(tmp_path)
        link_latest(newest)
    assert (tmp_path / "latest").resolve() == newest.resolve()


def test_a_link_that_cannot_be_made_is_left_out(tmp_path: Path) -> None:
    folder = new_folder(tmp_path)
    (tmp_path / "latest").mkdir()
    link_latest(folder)
    assert {path.name for path in tmp_path.iterdir()} == {folder.name, "latest"}


def test_a_new_an_empty_and_an_own_folder_are_welcome(tmp_path: Path) -> None:
    check_folder(tmp_path / "new", "# ours", "trial")
    check_folder(tmp_path, "# ours", "trial")
    (tmp_path / "config.yaml").write_text("# ours\nseed: 1\n", encoding="utf-8")
    check_folder(tmp_path, "# ours", "trial")


@pytest.mark.parametrize("content", [b"seed: 1\n", b"\xff\xfe"])
def test_a_folder_with_other_files_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(DataError, match=r"holds other files; name a new folder, or one of an earlier trial"):
        check_folder(tmp_path, "# ours", "trial")
