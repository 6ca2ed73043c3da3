"""Fetching of a public recording: a clone of its GitHub repository by the user's git, imported as data sets.

``recordings.yaml`` holds the names by which a user asks for one. A clone is whole, or it is not there.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from omnibench.check.misreadings import search
from omnibench.check.source import recognised, recorded
from omnibench.cli.examples import bundled_folder
from omnibench.cli.options import load_given_plugins
from omnibench.config import Model, read_model
from omnibench.data.dataset import Dataset
from omnibench.data.finding import UNITS
from omnibench.data.storage import check_dataset_folder, save_dataset
from omnibench.errors import ConfigError, DataError, nearest, not_written
from omnibench.files import check_place, refuse_existing, write_files
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import importers
from omnibench.slam.import_dataset import import_dataset

GITHUB = "https://github.com"
NEWEST = "HEAD"  # instead of a commit: the newest one, or of a clone that is there the one checked out
CLONES = Path("clones")  # where clones are kept, as OWNER/REPO
DATA = Path("data")  # where data sets go, where the user names no folder

# GitHub's rules for names, and a repository's address where one is pasted.
_REPOSITORY = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]*/(?!\.{1,2}$)[A-Za-z0-9._][A-Za-z0-9._-]*")
_ADDRESS = re.compile(r"^(?:https?://)?(?:www\.)?github\.com/|\.git/?$|/$")
_LICENCE = re.compile(r"(?:un)?licen[cs]e|copying", re.IGNORECASE)  # a file's name
_LONGEST = 80  # characters of a licence's title; chosen


class PublicDataset(Model):
    """The recordings of one robot.

    path: of its file or folder in the repository. runs: kinds of motion that were driven. options: of the importer.
    """

    name: str
    path: str
    robot: str = ""
    runs: str = ""
    options: dict[str, Any] = {}


class PublicRecording(Model):
    """A GitHub repository with recordings.

    commit: that the import was tested with. reference: what measured the poses. article: to cite; empty: there is none.
    plugin: the file in ``plugins`` that registers the importer; empty: it is built in.
    """

    name: str
    repository: str
    commit: str = NEWEST
    licence: str = ""
    reference: str = ""
    article: str = ""
    importer: str = ""
    plugin: str = ""
    datasets: tuple[PublicDataset, ...]


class _Catalogue(Model):
    recordings: tuple[PublicRecording, ...]


RECORDINGS = read_model(_Catalogue, Path(__file__).with_name("recordings.yaml")).recordings


def known_names() -> dict[str, PublicRecording]:
    """The recordings of the catalogue, and those of one data set, by each name that they have."""
    known: dict[str, PublicRecording] = {}
    for recording in RECORDINGS:
        known |= {recording.name: recording, recording.repository.lower(): recording}
        for dataset in recording.datasets:
            one = recording.model_copy(update={"datasets": (dataset,)})
            known |= {dataset.name: one, f"{recording.name}/{dataset.name}": one}
    return known


def find_recording(name: str) -> PublicRecording:
    """The recording of a name: a recording, a data set, RECORDING/DATASET, or OWNER/REPO on GitHub.

    One that the catalogue does not hold has no importer, and is one data set. ConfigError names the nearest known name
    and lists all.
    """
    known = known_names()
    repository = _ADDRESS.sub("", name)
    if (asked := known.get(name) or known.get(repository.lower())) is not None:
        return asked
    owner, _, title = repository.partition("/")
    if _REPOSITORY.fullmatch(repository) and owner not in known:
        whole = PublicDataset(name=title, path=".")
        return PublicRecording(name=repository, repository=repository, datasets=(whole,))
    short = ", ".join(sorted(each for each in known if "/" not in each))
    raise ConfigError(
        f"fetch: unknown recording {name!r}; {nearest(name, known)}known: {short}, and any OWNER/REPO on GitHub"
    )


# A connection on which hardly anything comes for a minute is given up: bytes per s, and s; chosen.
_STALLED = ("-c", "http.lowSpeedLimit=1000", "-c", "http.lowSpeedTime=60")
# Variables that would lead git to another repository, or make it ask for a password in a window.
_LEFT_OUT = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_ASKPASS", "SSH_ASKPASS")
_ENDLESS = 1e6  # s; with any limit Python waits in a way that Ctrl-C ends, even where polars restarts system calls
_COMMIT = re.compile(rf"{NEWEST}|[0-9a-fA-F]{{4,40}}")
_REMOTE = re.compile(r"github\.com[:/]+([^/]+/[^/]+?)(?:\.git)?/?$")
_ELSEWHERE = "import a clone made elsewhere (omnibench guide data)"


def open_clone(repository: str, folder: Path, commit: str, report: Reporter) -> str:
    """Clone OWNER/REPO into ``folder`` and check a commit out, whose full name it returns; a clone is used again.

    ConfigError or DataError in one line: no such repository or commit, no git, no network, no space, or the folder
    holds something else or a clone that was changed.
    """
    if shutil.which("git") is None:
        raise DataError(f"git is not installed, or not on the PATH; install it, or {_ELSEWHERE}")
    if not _COMMIT.fullmatch(commit):
        raise ConfigError(f"commit {commit!r}: expected 4 to 40 hexadecimal digits, or {NEWEST} for the newest")

    def work(*arguments: str | Path, clone: Path | None = None) -> None:
        report(Progress(task := f"git {arguments[0]}: {repository}"))
        ended = _git(*arguments, clone=clone)
        if ended.returncode:
            lines = [line for line in ended.stderr.splitlines() if line.startswith(("fatal:", "error:", "remote:"))]
            words = "; ".join(line.partition(":")[2].strip() for line in lines) or ended.stderr.strip()
            mend = f"check its name, the network and the disk, or {_ELSEWHERE}"
            raise DataError(f"{repository}: git could not {arguments[0]} it; {mend} (git: {words})")
        report(Progress(task, result=""))

    def check_out(clone: Path) -> str:
        if not (found := _commit_in(clone, commit)):
            raise ConfigError(f"{repository} has no commit {commit}; --commit {NEWEST} takes the newest")
        work("checkout", "--detach", found, clone=clone)
        return found

    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        away = f"move it away, and {repository} is cloned anew"
        if not (folder / ".git").exists():
            raise ConfigError(f"{folder} is there already and is no clone; {away}")
        remote = _ask(folder, "config", "--get", "remote.origin.url")
        cloned = _REMOTE.search(remote)
        if cloned is None or cloned[1].lower() != repository.lower():
            raise ConfigError(f"{folder} is a clone of {remote or 'nothing'}, not of {repository}; {away}")
        if changed := _ask(folder, "status", "--porcelain", "--untracked-files=all").splitlines():
            raise ConfigError(f"{folder}: {changed[0].split(maxsplit=1)[-1]} is not as in the repository; {away}")
        found, present = _commit_in(folder, commit), _commit_in(folder, NEWEST)
        if found and found == present:
            return found
        if not found:
            whole = ("--unshallow",) if (folder / ".git" / "shallow").exists() else ()
            work("fetch", *whole, "origin", clone=folder)
        return check_out(folder)
    # It is cloned into a temporary folder on the same disk, and moved once it is whole.
    check_place(folder)
    existing = next(parent for parent in folder.absolute().parents if parent.is_dir())
    try:
        with TemporaryDirectory(prefix=".clone-", dir=existing, ignore_cleanup_errors=True) as temporary:
            clone = Path(temporary, "clone")
            # The whole history, in which a commit is looked for, without the files of other commits.
            work("clone", "--filter=blob:none", "--no-checkout", f"{GITHUB}/{repository}.git", clone)
            found = check_out(clone)
            folder.parent.mkdir(parents=True, exist_ok=True)
            clone.rename(folder)
    except OSError as error:
        raise not_written(folder, error) from None
    return found


def _git(*arguments: str | Path, clone: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A git command that has ended; it speaks English and never asks for a password, in a terminal or in a window."""
    environment = {name: value for name, value in os.environ.items() if name not in _LEFT_OUT}
    environment |= {"GIT_TERMINAL_PROMPT": "0", "GCM_INTERACTIVE": "never", "LC_ALL": "C"}
    return subprocess.run(
        ["git", *_STALLED, *arguments], cwd=clone, env=environment, stdin=subprocess.DEVNULL, capture_output=True,
        text=True, errors="replace", timeout=_ENDLESS, check=False,
    )  # fmt: skip


def _ask(clone: Path, *arguments: str) -> str:
    """Output of a git command in a clone; empty if the command fails."""
    answer = _git(*arguments, clone=clone)
    return answer.stdout.strip() if answer.returncode == 0 else ""


def _commit_in(clone: Path, commit: str) -> str:
    """The full name of a commit; empty if the clone does not hold it."""
    return _ask(clone, "rev-parse", "--verify", f"{commit}^{{commit}}")


@dataclass(frozen=True)
class Fetched:
    """A public recording on this disk.

    folder, commit: of the clone of its repository. licence: as the data sets say it, empty if it is not known.
    licence_file: its text in the clone. datasets: by their folders. refusal: why nothing was imported; importer: that
    was tried.
    """

    recording: PublicRecording
    folder: Path
    commit: str
    licence: str = ""
    licence_file: Path | None = None
    datasets: Mapping[Path, Dataset] = field(default_factory=dict)
    refusal: str = ""
    importer: str = ""

    @property
    def source(self) -> str:
        """The origin, as the data sets say it."""
        return f"public GitHub repository {self.recording.repository}, commit {self.commit}"


def fetch_recording(
    name: str,
    output: Path | None = None,
    *,
    commit: str | None = None,
    force: bool = False,
    report: Reporter = no_progress,
) -> Fetched:
    """Clone a public recording into ``CLONES`` and import it; a clone that is there is used again.

    name: of the catalogue, or OWNER/REPO on GitHub, which is imported where its format is recognised. output: folder of
    the data set, or of several data sets. commit: to check out, ``HEAD`` for the newest; default: the one tested, or
    the newest. force: replace data sets that are there. ConfigError, DataError or PluginError in one line.
    """
    asked = find_recording(name)
    # The folder that was named, or one below it for each of several data sets.
    folders = [(output or DATA) / dataset.name for dataset in asked.datasets]
    if output is not None and len(folders) == 1:
        folders = [output]
    for folder in folders:
        check_dataset_folder(folder)
    refuse_existing(*folders, force=force, folders=True)
    place = CLONES / asked.repository
    commit = open_clone(asked.repository, place, commit or asked.commit, report)
    # The importer is the catalogue's plug-in, unless one of that name is there.
    if asked.plugin and asked.importer not in [entry.name for entry in importers.entries()]:
        load_given_plugins([Path("none")], [bundled_folder() / "plugins" / asked.plugin])
    named = (file for file in sorted(place.iterdir()) if _LICENCE.fullmatch(file.name.partition(".")[0]))
    file = next((file for file in named if file.is_file()), None)
    text = "" if file is None else file.read_text(encoding="utf-8", errors="replace")
    licence = asked.licence or text.strip().partition("\n")[0].strip()[:_LONGEST]  # the first line is its title
    fetched = Fetched(asked, place, commit, licence, file, importer=asked.importer)
    for folder, asked_dataset in zip(folders, asked.datasets, strict=True):
        source = place / asked_dataset.path
        if not source.exists():
            raise DataError(f"{source} is not in commit {commit[:8]}; leave --commit out to take the one tested")
        report(Progress(task := f"importing {asked_dataset.name}"))
        try:
            fetched = replace(fetched, importer=asked.importer or recognised(source))
            # The importer's options hold origin and licence where they can, to be kept when it is imported again.
            origin = {"name": folder.resolve().name, "source": fetched.source, "licence": licence}
            fields = importers.entry(fetched.importer).options.model_fields
            given = {key: text for key, text in origin.items() if key in fields and text and text.isprintable()}
            dataset = import_dataset(fetched.importer, source, {**given, **asked_dataset.options})
            mistakes = () if asked.importer else search(recorded(dataset)).mistakes
            if wrong := [mistake.what for mistake in mistakes if mistake.kind in UNITS]:
                raise DataError("; ".join(wrong))
        except (ConfigError, DataError) as refusal:
            if asked.importer:
                raise
            return replace(fetched, refusal=str(refusal))
        finally:
            report(Progress(task, result=""))
        dataset = replace(dataset, source=fetched.source, licence=licence or dataset.licence)
        save_dataset(dataset, folder, overwrite=force)
        if file is not None:
            write_files({folder / file.name: file.read_bytes()})
        fetched = replace(fetched, datasets={**fetched.datasets, folder: dataset})
    return fetched
