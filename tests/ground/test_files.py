"""Files are written whole or not at all, devices and pipes are never replaced, and foreign folders are refused."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from omnibench.errors import DataError, one_line, visible
from omnibench.files import check_results_folder, link_latest, new_results_folder, replacing, results_locked, write_text


def test_a_link_goes_on_pointing_to_the_file_that_is_written(tmp_path: Path) -> None:
    (tmp_path / "file.yaml").write_text("old")
    (tmp_path / "link.yaml").symlink_to("file.yaml")
    write_text(tmp_path / "link.yaml", "new")
    assert (tmp_path / "link.yaml").is_symlink()
    assert (tmp_path / "file.yaml").read_text() == "new"


def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_text(pipe, "through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_full_device_is_one_line(tmp_path: Path) -> None:
    device = tmp_path / "full"
    try:
        os.mknod(device, stat.S_IFCHR | 0o600, os.makedev(1, 7))  # as /dev/full, but not the system's own
        device.write_text("x")
    except PermissionError:
        pytest.skip("devices cannot be made here")
    except OSError:
        with pytest.raises(DataError, match="No space left on device; free space or choose another place"):
            write_text(device, "x")
        assert stat.S_ISCHR(device.stat().st_mode)
    else:
        pytest.fail("the device took what it was given")


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EISDIR, "is a folder; name a file"),
        (errno.ENOSPC, "No space left on device; free space"),
        (errno.EACCES, "Permission denied; get permission"),
        (errno.EROFS, "Read-only file system; choose another place"),
    ],
)
def test_the_advice_fits_what_the_disk_refuses(number: int, words: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"cannot be written: {words}"), replacing(tmp_path / "x"):
        raise OSError(number, os.strerror(number))


def test_a_text_from_anywhere_becomes_one_line_that_can_be_written_and_controls_no_terminal(tmp_path: Path) -> None:
    line = one_line("a\nb\x1b[31m\ud800 \u202ec\u3000d\u00a0e")
    assert line == "a b?[31m? ?c d e"
    assert visible("a\u3000b\u200dc\nd\x07") == "a\u3000b\u200dc\nd?"
    write_text(tmp_path / "reason", line)


def test_folders_of_the_same_second_have_names_of_their_own_and_the_newest_is_linked(tmp_path: Path) -> None:
    folders = [new_results_folder(tmp_path) for _ in range(4)]
    assert len(set(folders)) == 4
    for folder in folders:
        link_latest(folder)
    assert (tmp_path / "latest").resolve() == folders[-1].resolve()


def test_a_link_that_cannot_be_made_is_left_out(tmp_path: Path) -> None:
    folder = new_results_folder(tmp_path)
    (tmp_path / "latest").mkdir()
    link_latest(folder)
    assert {path.name for path in tmp_path.iterdir()} == {folder.name, "latest"}


def test_a_new_an_empty_and_an_own_folder_are_welcome(tmp_path: Path) -> None:
    check_results_folder(tmp_path / "new", "# ours", "trial")
    check_results_folder(tmp_path, "# ours", "trial")
    (tmp_path / "config.yaml").write_text("# ours\nseed: 1\n", encoding="utf-8")
    check_results_folder(tmp_path, "# ours", "trial")


@pytest.mark.parametrize("content", [b"seed: 1\n", b"\xff\xfe"])
def test_a_folder_with_other_files_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(DataError, match=r"holds other files; name a new folder, or one of an earlier trial"):
        check_results_folder(tmp_path, "# ours", "trial")


def test_a_folder_of_results_is_free_again_when_the_process_that_wrote_there_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    writes = (
        "import sys, time\nfrom pathlib import Path\nfrom omnibench.files import results_locked\n"
        "with results_locked(Path(sys.argv[1])):\n    print(flush=True)\n    time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", writes, str(folder)], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        refusal = f"^{folder}: another omnibench is writing results there; name another folder"
        with pytest.raises(DataError, match=refusal), results_locked(folder):
            pass
        process.kill()
    with results_locked(folder):
        assert list(folder.iterdir()) == []


def test_a_file_is_on_the_disk_before_it_replaces_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[str, str]] = []

    def sync(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        calls.append((path.name.partition(".")[2].partition(".")[0], (tmp_path / "state.yaml").read_text()))

    monkeypatch.setattr(os, "fsync", sync)
    write_text(tmp_path / "state.yaml", "old")
    assert calls == []
    write_text(tmp_path / "state.yaml", "new")
    assert calls == [("state", "old"), ("", "new")]
