"""``omnibench fetch``: the user's git clones from bare repositories in a folder that stands for GitHub; no network."""

import os
import shutil
import signal
import subprocess
from pathlib import Path

import polars as pl
import pytest
from commands import COMMAND, ENVIRONMENT, RECORDINGS, ROOT, Command, Prepared, Printed, succeeded
from corelli import CORELLI
from real_recordings import OMNI3, ROBOTINO
from timing import PATIENCE, until

from omnibench.cli import fetch
from omnibench.cli.examples import EXAMPLES
from omnibench.cli.fetch import RECORDINGS as KNOWN
from omnibench.cli.fetch import find_recording
from omnibench.cli.handbook_topics import find_topic
from omnibench.data.storage import load_dataset

GIT = shutil.which("git")
pytestmark = pytest.mark.skipif(GIT is None, reason="git is not installed")
LICENCE = "MIT License\n\nCopyright (c) somebody\n"
OPTIODOM, CLONE = "sousarbarb/optiodom", Path("clones/sousarbarb/optiodom")

# A session of the layout of OptiOdom: two seconds of a differential drive, straight ahead.
METADATA = "type,diff\nngear,43.7\nencRes,64\nDi,0.084,0.084\nLi,0.2\n"
RUN = "".join(f"{0.05 * k:.2f},{0.01 * k:.2f},0,0,106,106\n" for k in range(40))


class GitHub:
    """Bare repositories in a folder, which git finds in the place of those on GitHub, and nothing else."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.monkeypatch = monkeypatch
        self.environment = {
            "GIT_CONFIG_GLOBAL": os.devnull,
            "GIT_CONFIG_COUNT": "1",
            "GIT_CONFIG_KEY_0": f"url.file://{folder}/.insteadOf",
            "GIT_CONFIG_VALUE_0": "https://github.com/",
            "GIT_ALLOW_PROTOCOL": "file",  # never the network
        }
        for name, value in self.environment.items():
            monkeypatch.setenv(name, value)

    def git(self, folder: Path, *arguments: object) -> str:
        command = [str(GIT), "-C", str(folder), "-c", "user.name=x", "-c", "user.email=x@y", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE).stdout.strip()

    def publish(self, repository: str, files: dict[str, str | Path]) -> str:
        """A commit of files (their text, or where they or their folders are copied from) to a repository; its name."""
        bare, work = self.folder / f"{repository}.git", self.folder / "work" / repository
        if not bare.exists():
            work.mkdir(parents=True)
            bare.mkdir(parents=True)
            self.git(bare, "init", "--bare", "-q")
            for key in ("uploadpack.allowFilter", "uploadpack.allowAnySHA1InWant"):  # as GitHub's
                self.git(bare, "config", key, "true")
            self.git(work, "init", "-q")
        for name, content in files.items():
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, str):
                (work / name).write_text(content, encoding="utf-8")
            else:
                (shutil.copytree if content.is_dir() else shutil.copy)(content, work / name)
        self.git(work, "add", "-A")
        self.git(work, "commit", "-q", "-m", "x")
        self.git(work, "push", "-q", bare, "HEAD")
        return self.git(work, "rev-parse", "HEAD")

    def tested(self, **commits: str) -> None:
        """Commits that stand in the catalogue, by the recordings' names."""
        known = [each.model_copy(update={"commit": commits.get(each.name, each.commit)}) for each in KNOWN]
        self.monkeypatch.setattr(fetch, "RECORDINGS", tuple(known))


@pytest.fixture
def github(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> GitHub:
    folder = tmp_path / "github"
    folder.mkdir()
    return GitHub(folder, monkeypatch)


@pytest.fixture
def optiodom(github: GitHub) -> str:
    """A small repository of OptiOdom's layout, as the catalogue knows it; the tested commit, before the newest."""
    session = {f"data/diff/{group}/1/1_run-{run:02}.csv": RUN for group in ("circular", "square") for run in (1, 2)}
    session |= {f"data/diff/{group}/1/1_metadata.csv": METADATA for group in ("circular", "square")}
    commit = github.publish(OPTIODOM, {"LICENSE": LICENCE, **session})
    github.publish(OPTIODOM, {"README.md": "newer\n"})
    github.tested(optiodom=commit[:8])
    return commit


def assert_failed(run: Printed, *parts: str) -> None:
    """Assert exit code 2 and one last line, after lines of progress, with all parts."""
    assert (run.returncode, run.stdout) == (2, ""), run.stdout + run.stderr
    *progress, error = run.stderr.splitlines()
    assert error.startswith("error: ")
    assert not [line for line in progress if "error" in line]
    for part in parts:
        assert part in error


def test_it_is_cloned_at_the_tested_commit_and_imported(command: Command, optiodom: str) -> None:
    ended = succeeded(command("fetch", "diff"))
    said = ended.stdout.splitlines()
    source = f"public GitHub repository {OPTIODOM}, commit {optiodom}"
    assert said[:3] == [
        "4 trajectories: data/diff",
        f"source: {source}, in {CLONE}",
        "licence: MIT (data/diff/LICENSE)",
    ]
    assert said[3].startswith("cite: Sousa, Petry, Costa, Moreira: OptiOdom")
    assert "git clone: sousarbarb/optiodom" in ended.stderr
    assert ended.stderr.splitlines()[-1] == "  omnibench check data/diff"
    dataset = load_dataset("data/diff")
    assert (dataset.name, dataset.source, dataset.licence) == ("diff", source, "MIT")
    assert dataset.imported.options == {"name": "diff", "source": source}
    assert Path("data/diff/LICENSE").read_text(encoding="utf-8") == LICENCE
    assert command("check", "data/diff").returncode < 2


def test_a_clone_that_is_there_is_used_again(command: Command, github: GitHub, optiodom: str) -> None:
    assert command("fetch", "optiodom/diff").returncode == 0
    shutil.rmtree(github.folder)  # the network is gone
    before = (CLONE / ".git" / "HEAD").stat().st_mtime_ns
    again = succeeded(command("fetch", "diff", "-o", "again"))
    assert "git" not in again.stderr
    assert (CLONE / ".git" / "HEAD").stat().st_mtime_ns == before
    assert optiodom in load_dataset("again").source


def test_another_commit_is_checked_out_in_it(command: Command, github: GitHub, optiodom: str) -> None:
    newest = succeeded(command("fetch", "diff", "--commit", "HEAD"))
    assert optiodom not in newest.stdout
    assert optiodom in command("fetch", "diff", "--force").stdout
    commit = github.publish(OPTIODOM, {"README.md": "newest\n"})
    assert commit in command("fetch", "diff", "--force", "--commit", commit[:10]).stdout


@pytest.mark.parametrize("depth", [(), ("--depth", "1")])
def test_a_clone_from_elsewhere_needs_no_network_unless_it_lacks_its_history(
    command: Command, github: GitHub, optiodom: str, depth: tuple[str, ...]
) -> None:
    CLONE.parent.mkdir(parents=True)
    github.git(Path(), "clone", "-q", *depth, f"https://github.com/{OPTIODOM}", CLONE)
    if not depth:
        shutil.rmtree(github.folder)
    assert optiodom in command("fetch", "diff").stdout


def test_a_data_set_that_is_there_is_refused_before_a_clone(command: Command, optiodom: str) -> None:
    assert optiodom
    Path("data/diff").mkdir(parents=True)
    Path("data/diff/dataset.yaml").write_text("mine\n", encoding="utf-8")
    assert_failed(command("fetch", "diff"), "data/diff is there already", "--force")
    assert not CLONE.exists()
    assert command("fetch", "diff", "--force").returncode == 0
    assert load_dataset("data/diff").name == "diff"


def test_what_the_commit_does_not_hold_is_said(command: Command, optiodom: str) -> None:
    assert_failed(command("fetch", "omni3"), f"{CLONE}/data/omni3 is not in commit {optiodom[:8]}")


@pytest.mark.slow
@pytest.mark.skipif(not OMNI3.is_dir(), reason=f"the OptiOdom recordings are not at {OMNI3}")
def test_every_robot_of_a_repository_gets_a_data_set(command: Command, github: GitHub) -> None:
    sessions = ("diff/circular/231220200121", "tricyc/square", "omni3/square", "omni4/circular/231220200453")
    files: dict[str, str | Path] = {f"data/{each}": RECORDINGS / "optiodom" / each for each in sessions}
    github.tested(optiodom=github.publish(OPTIODOM, {"LICENSE": LICENCE, **files}))
    ended = succeeded(command("fetch", "optiodom", "-o", "robots"))
    listed = [line.split(": ")[1] for line in ended.stdout.splitlines()[:4]]
    assert listed == [f"robots/{name}" for name in ("diff", "tricyc", "omni3", "omni4")]
    assert load_dataset("robots/omni3").licence == "MIT"


@pytest.mark.slow
@pytest.mark.skipif(not ROBOTINO.is_dir(), reason=f"the recordings are not at {ROBOTINO}")
def test_the_importer_may_be_a_plug_in_that_comes_with_omnibench(command: Command, github: GitHub) -> None:
    (robotino,) = find_recording("robotino").datasets
    runs = ROBOTINO / "one_surface_type" / "table_surface"
    files: dict[str, str | Path] = {f"{robotino.path}/exp0{k}.csv": runs / f"exp0{k}.csv" for k in range(4)}
    commit = github.publish("BrOleg5/research-wheel-slippage", files)
    github.tested(robotino=commit)
    ended = succeeded(command("fetch", "https://github.com/BrOleg5/Research-Wheel-Slippage.git"))
    assert "licence: Apache-2.0\n" in ended.stdout  # the repository here holds no text of it
    assert "cite: https://github.com/BrOleg5/research-wheel-slippage\n" in ended.stdout
    assert commit in load_dataset("data/robotino").source


@pytest.mark.slow
@pytest.mark.skipif(not CORELLI.is_file(), reason=f"the recording is not at {CORELLI}")
def test_options_of_the_catalogue_are_taken(command: Command, github: GitHub) -> None:
    github.tested(corelli=github.publish(find_recording("corelli").repository, {"dataset.txt": CORELLI}))
    assert command("fetch", "corelli").returncode == 0
    dataset = load_dataset("data/corelli")
    assert (dataset.robot.name, dataset.licence) == ("corelli", "Apache-2.0")
    assert dataset.imported.options["steering_scale"] == 0.1


def test_a_recognised_format_is_imported(command: Command, github: GitHub, prepared: Prepared) -> None:
    files: dict[str, str | Path] = {file.name: file for file in prepared.data.iterdir()}
    commit = github.publish("somebody/runs", {**files, "LICENCE.txt": "\nCC-BY-4.0\nall of it\n"})
    ended = succeeded(command("fetch", "somebody/runs"))
    assert "licence: CC-BY-4.0 (data/runs/LICENCE.txt)\n" in ended.stdout
    dataset = load_dataset("data/runs")
    assert dataset.licence == "CC-BY-4.0"
    assert f"somebody/runs, commit {commit}" in dataset.source


def test_what_cannot_be_imported_is_cloned_and_the_next_step_said(command: Command, github: GitHub) -> None:
    github.publish("somebody/log", {"log.csv": "t,ticks_left,ticks_right\n0.1,1,2\n"})
    ended = succeeded(command("fetch", "somebody/log"))
    assert Path("clones/somebody/log/log.csv").is_file()
    assert not Path("data").exists()
    assert "licence: the repository states none; ask its authors" in ended.stdout
    assert "\nnot imported: " in ended.stderr
    assert "robot" in ended.stderr
    assert ended.stderr.splitlines()[-1] == "  omnibench import csv --help"
    github.publish("somebody/words", {"README.md": "words\n"})
    ended = succeeded(command("fetch", "somebody/words"))
    assert "no recording is recognised there" in ended.stderr


def test_impossible_units_are_not_imported(command: Command, github: GitHub, prepared: Prepared) -> None:
    (table,) = Path(shutil.copytree(prepared.data, "degrees")).glob("poses.parquet")
    pl.read_parquet(table).with_columns(pl.col("theta").degrees()).write_parquet(table)
    files: dict[str, str | Path] = {file.name: file for file in Path("degrees").iterdir()}
    github.publish("somebody/degrees", files)
    ended = command("fetch", "somebody/degrees")
    assert "\nnot imported: theta looks like degrees" in ended.stderr
    assert not Path("data").exists()


class TestMistakes:
    @pytest.mark.parametrize(
        ("name", "parts"),
        [
            *((name, (f"{name!r}; did you mean", "omni3'?")) for name in ("omn3", "optiodom/omn3", "optiodom/omni33")),
            *((name, ("known: corelli",)) for name in ("../optiodom", "-x/y", "a/..", "https://example.org/a/b", "")),
            ("nobody/nothing", ("nobody/nothing: git could not clone it; check its name",)),
        ],
    )
    def test_a_missing_one_is_named(self, command: Command, github: GitHub, name: str, parts: tuple[str, ...]) -> None:
        assert github
        assert_failed(command("fetch", "--", name), *parts)
        assert not Path("clones").exists()

    def test_a_commit_that_is_missing(self, command: Command, optiodom: str) -> None:
        assert optiodom
        missing = command("fetch", "diff", "--commit", "deadbeef")
        assert_failed(missing, "sousarbarb/optiodom has no commit deadbeef; --commit HEAD takes the newest")
        assert not Path("clones").exists()
        assert_failed(command("fetch", "diff", "--commit", "--upload-pack=x"), "hexadecimal")

    def test_git_is_missing(self, command: Command, optiodom: str, monkeypatch: pytest.MonkeyPatch) -> None:
        assert optiodom
        monkeypatch.setenv("PATH", os.devnull)
        assert_failed(command("fetch", "diff"), "git is not installed", "omnibench guide data")

    def test_what_git_says_is_told_in_one_line_with_what_to_do(
        self, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        words = "unable to access 'https://github.com/': Could not resolve host: github.com"
        pretend_git(tmp_path / "bin", f'mkdir -p "$folder"; echo "fatal: {words}" >&2; exit 128')
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
        assert_failed(
            command("fetch", "diff"), "check its name, the network and the disk", words, "omnibench guide data"
        )
        assert not Path("clones").exists()

    def test_a_clone_that_was_changed_is_refused(self, command: Command, optiodom: str) -> None:
        assert optiodom
        assert command("fetch", "diff").returncode == 0
        run = CLONE / "data" / "diff" / "circular" / "1" / "1_run-01.csv"
        run.write_text("mine\n", encoding="utf-8")
        assert_failed(command("fetch", "diff", "--force"), "1_run-01.csv is not as in the repository", "move it away")
        assert run.read_text(encoding="utf-8") == "mine\n"

    def test_a_folder_with_something_else_is_refused(self, command: Command, github: GitHub, optiodom: str) -> None:
        assert optiodom
        CLONE.mkdir(parents=True)
        (CLONE / "mine.txt").write_text("mine\n", encoding="utf-8")
        assert_failed(command("fetch", "diff"), f"{CLONE} is there already and is no clone; move it away")
        (CLONE / "mine.txt").unlink()
        github.git(CLONE, "init", "-q")
        github.git(CLONE, "remote", "add", "origin", "https://github.com/other/optiodom")
        assert_failed(command("fetch", "diff"), "is a clone of https://github.com/other/optiodom", "move it away")

    def test_ctrl_c_leaves_no_half_clone_and_no_git(self, tmp_path: Path) -> None:
        pretend_git(tmp_path / "bin", f'mkdir -p "$folder"; echo $$ > {tmp_path}/pid; exec sleep 1000')
        path = f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"
        process = subprocess.Popen(
            [*COMMAND, "fetch", "diff"], cwd=tmp_path, env=ENVIRONMENT | {"PATH": path, "PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text(), "git to begin")
        assert list(tmp_path.glob(".clone-*"))
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130
        assert said.splitlines()[-1] == "interrupted; the same command begins anew"
        assert not [*tmp_path.glob(".clone-*"), *tmp_path.glob("clones")]
        until(lambda: not Path("/proc", (tmp_path / "pid").read_text().strip()).exists(), "git to end")


def pretend_git(folder: Path, cloning: str) -> None:
    """A program ``git`` that does something else where it is told to clone into $folder."""
    folder.mkdir()
    script = f'#!/bin/sh\nfor folder; do :; done\ncase " $* " in *" clone "*) {cloning};; esac\nexec {GIT} "$@"\n'
    (folder / "git").write_text(script, encoding="utf-8")
    (folder / "git").chmod(0o755)


def test_the_list_shows_every_data_set_and_the_example_compares_what_it_fetches(command: Command) -> None:
    lines = command("fetch").stdout.splitlines()
    named = [line.split()[0] for line in lines if line.startswith("  ")]
    assert named == [dataset.name for recording in KNOWN for dataset in recording.datasets]
    (commands,) = (each.commands for each in EXAMPLES if each.name == "omni3")
    dataset = find_recording(commands[0].split()[-1])
    assert f"clones/{dataset.repository}/{dataset.datasets[0].path}" in commands[1]


def test_the_handbook_has_the_catalogue_word_for_word() -> None:
    page = find_topic("data").text
    for recording in KNOWN:
        assert recording.repository in page
        for each in recording.datasets:
            row = f"| {each.robot} | {each.runs} | {recording.licence} |"
            assert f"| `omnibench fetch {each.name}` {row}" in page
