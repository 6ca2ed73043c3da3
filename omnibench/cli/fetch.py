"""Fetching of a public recording: a clone of its GitHub repository, imported as data sets.

The catalogue holds the names by which a user asks for one. Clones are made by the user's
git: a clone is whole, or it is not there.
"""

from __future__ import annotations

import os
import re
import select
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omnibench.check.misreadings import search
from omnibench.check.source import recognised, recorded
from omnibench.cli.examples import bundled_folder
from omnibench.config import Model, read_model
from omnibench.data.dataset import Dataset
from omnibench.data.finding import UNITS
from omnibench.data.storage import check_dataset_folder, save_dataset
from omnibench.errors import ConfigError, DataError, PluginError, nearest
from omnibench.files import check_place, refuse_existing, write_files
from omnibench.processes import interrupts_deferred
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import importers, load_plugin_file
from omnibench.slam.import_dataset import import_dataset

GITHUB = "https://github.com"
NEWEST = "HEAD"  # instead of a commit: the newest one, or of a clone that is there the one checked out

# GitHub's rules for names, and a repository's address where one is pasted.
_REPOSITORY = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]*/(?!\.{1,2}$)[A-Za-z0-9._][A-Za-z0-9._-]*")
_ADDRESS = re.compile(r"^(?:https?://)?(?:www\.)?github\.com/|\.git/?$|/$")


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


def find_recording(name: str) -> PublicRecording:
    """The recording of a name: a recording, a data set, RECORDING/DATASET, or OWNER/REPO on GitHub.

    One that the catalogue does not hold has no importer, and is one data set. ConfigError names the nearest known name
    and lists all.
    """
    known: dict[str, PublicRecording] = {}
    by_repository: dict[str, PublicRecording] = {}
    for recording in RECORDINGS:
        for dataset in recording.datasets:
            one = recording.model_copy(update={"datasets": (dataset,)})
            known |= {dataset.name: one, f"{recording.name}/{dataset.name}": one}
        known[recording.name] = by_repository[recording.repository.lower()] = recording
    repository = _ADDRESS.sub("", name)
    if (asked := known.get(name) or by_repository.get(repository.lower())) is not None:
        return asked
    owner = repository.partition("/")[0]
    if _REPOSITORY.fullmatch(repository) and owner not in {recording.name for recording in RECORDINGS}:
        whole = PublicDataset(name=repository.partition("/")[2], path=".")
        return PublicRecording(name=repository, repository=repository, datasets=(whole,))
    short = [each for each in known if "/" not in each]
    raise ConfigError(
        f"fetch: unknown recording {name!r}; {nearest(name, known)}known: {', '.join(sorted(short))}, and any "
        "OWNER/REPO on GitHub"
    )


_PATIENCE = 10.0  # s for git to end after it was told to; chosen
# A connection on which hardly anything comes for a minute is given up: bytes per s, and s; chosen.
_STALLED = ("-c", "http.lowSpeedLimit=1000", "-c", "http.lowSpeedTime=60")
# Variables that would lead git to another repository, or make it ask for a password in a window.
_LEFT_OUT = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_ASKPASS", "SSH_ASKPASS")
_COMMIT = re.compile(rf"{NEWEST}|[0-9a-fA-F]{{4,40}}")
_REMOTE = re.compile(r"github\.com[:/]+([^/]+/[^/]+?)(?:\.git)?/?$")
_STEP = re.compile(r"(Receiving objects|Resolving deltas|Updating files): +\d+% \((\d+)/(\d+)\)(?:, ([\d.]+ \w+))?")
_ELSEWHERE = "import a clone made elsewhere (omnibench guide data)"
# Git's words, and what they mean to a user; the first that fits counts.
_CAUSES = (
    (r"no space left|quota exceeded", "no space is left on the disk; free space, or fetch in another folder"),
    (
        r"repository.* not found|could not read username|authentication failed|does not exist|not appear to be a git",
        "GitHub has no public repository of this name; check its spelling",
    ),
    (
        r"could not resolve|unable to access|failed to connect|timed out|unreachable|connection|early eof|hung up",
        f"github.com cannot be reached; {_ELSEWHERE}",
    ),
)


def open_clone(repository: str, folder: Path, commit: str, report: Reporter) -> str:
    """Clone OWNER/REPO into ``folder`` and check a commit out, whose full name it returns; a clone is used again.

    ConfigError or DataError in one line: no such repository or commit, no git, no network, no space, or the folder
    holds something else or a clone that was changed.
    """
    if shutil.which("git") is None:
        raise DataError(f"git is not installed, or not on the PATH; install it, or {_ELSEWHERE}")
    if not _COMMIT.fullmatch(commit):
        raise ConfigError(f"commit {commit!r}: expected 4 to 40 hexadecimal digits, or {NEWEST} for the newest")
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
        if not _find(folder, commit):
            whole = ("--unshallow",) if _ask(folder, "rev-parse", "--is-shallow-repository") == "true" else ()
            _work(repository, ("fetch", "--progress", *whole, "origin"), folder, report)
        if _find(folder, commit) != _find(folder, NEWEST):
            _check_out(repository, folder, commit, report)
        return _find(folder, NEWEST)
    # It is cloned into a folder beside, which is renamed once it is whole; whatever ends this leaves nothing there.
    check_place(folder)
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    made = [parent for parent in folder.parents if not parent.exists()]
    # A commit is looked for in the whole history, without the files of other commits.
    part = ("--depth", "1") if commit == NEWEST else ("--filter=blob:none", "--no-checkout")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _work(repository, ("clone", "--progress", *part, f"{GITHUB}/{repository}.git", str(partial)), None, report)
        if commit != NEWEST:
            _check_out(repository, partial, commit, report)
        partial.rename(folder)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}; choose another place") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):
            for parent in made:  # they stay unless empty
                parent.rmdir()
    return _find(folder, NEWEST)


def _check_out(repository: str, folder: Path, commit: str, report: Reporter) -> None:
    if not (found := _find(folder, commit)):
        raise ConfigError(f"{repository} has no commit {commit}; --commit {NEWEST} takes the newest")
    _work(repository, ("checkout", "--progress", "--detach", found), folder, report)


def _find(folder: Path, commit: str) -> str:
    """The full name of a commit; empty if the clone does not hold it."""
    return _ask(folder, "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}")


def _environment() -> dict[str, str]:
    """Git's variables: it speaks English and never asks for a password, in a terminal or in a window."""
    kept = {name: value for name, value in os.environ.items() if name not in _LEFT_OUT}
    return kept | {"GIT_TERMINAL_PROMPT": "0", "GCM_INTERACTIVE": "never", "LC_ALL": "C"}


def _ask(folder: Path, *arguments: str) -> str:
    """Output of a git command in a clone; empty if the command fails."""
    command, silent = ["git", "-C", str(folder), *arguments], subprocess.DEVNULL
    answer = subprocess.run(command, env=_environment(), stdin=silent, capture_output=True, check=False)
    return answer.stdout.decode(errors="replace").strip() if answer.returncode == 0 else ""


def _work(repository: str, arguments: Sequence[str], folder: Path | None, report: Reporter) -> None:
    """Let git work and report its progress. DataError in one line: it failed. Ctrl-C ends git, too."""
    command = ["git", *_STALLED, *(() if folder is None else ("-C", str(folder))), *arguments]
    task = f"git {arguments[0]}: {repository}"
    report(Progress(task))
    silent, said = subprocess.DEVNULL, list[str]()
    process: subprocess.Popen[bytes] | None = None
    try:
        with interrupts_deferred():  # a Ctrl-C while git starts would leave it running
            process = subprocess.Popen(
                command, env=_environment(), stdin=silent, stdout=silent, stderr=subprocess.PIPE, start_new_session=True
            )
        for line in _lines(process):
            if (step := _STEP.search(line)) is not None:
                report(Progress(step[1].lower(), int(step[2]), int(step[3]), "object", note=step[4] or ""))
            else:
                said.append(line)
        process.wait()
    except BaseException:
        if process is None:  # there is no git
            raise
        # Git ends, and the programs that it has started.
        for number in (signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, number)
            with suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE)
                break
        raise
    if process.returncode:
        complaints = [line for line in said if line.startswith(("fatal:", "error:", "remote:"))]
        words = "; ".join(line.partition(":")[2].strip() for line in complaints) or " ".join(said[-1:]) or "it failed"
        for pattern, meaning in _CAUSES:
            if re.search(pattern, " ".join(said), re.IGNORECASE):
                raise DataError(f"{repository}: {meaning} (git: {words})")
        raise DataError(f"{repository}: git could not clone it: {words}")
    report(Progress(task, result=""))


def _lines(process: subprocess.Popen[bytes]) -> Iterator[str]:
    """Lines of a program's standard error; bars that it draws end in a carriage return.

    Ctrl-C ends the wait for the next line, which is a ``select``; reads that it interrupts begin anew once polars is
    imported, since its handler of the signal restarts them (SA_RESTART).
    """
    assert process.stderr is not None
    begun, stream = "", process.stderr.fileno()
    while True:
        select.select([stream], [], [])
        part = os.read(stream, 1 << 16)
        *lines, begun = re.split(r"[\r\n]+", begun + part.decode(errors="replace"))
        yield from (line.strip() for line in lines)
        if not part:
            yield from filter(None, [begun.strip()])
            return


CLONES = Path("clones")  # where clones are kept, as OWNER/REPO
DATA = Path("data")  # where data sets go, where the user names no folder

_LICENCE = re.compile(r"(?:un)?licen[cs]e|copying", re.IGNORECASE)
_LONGEST = 80  # characters of a licence's title; chosen


@dataclass(frozen=True)
class Fetched:
    """A public recording on this disk.

    folder, commit: of the clone of its repository. cite: the article, or else the repository. licence: as the data sets
    say it, empty if it is not known. licence_file: its text in the clone. datasets: by their folders. refusal: why
    nothing was imported; importer: that was tried.
    """

    repository: str
    folder: Path
    commit: str
    cite: str
    licence: str
    licence_file: Path | None
    datasets: Mapping[Path, Dataset]
    refusal: str = ""
    importer: str = ""

    @property
    def source(self) -> str:
        """The origin, as the data sets say it."""
        return f"public GitHub repository {self.repository}, commit {self.commit}"


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
        failure = load_plugin_file(bundled_folder() / "plugins" / asked.plugin)
        if failure is not None:
            raise PluginError(f"plug-in {failure.origin} cannot be imported: {failure.error}")
    licence, file = asked.licence, _licence_file(place)
    if not asked.importer and file is not None:
        # A licence's title is the first line of its text.
        text = file.read_text(encoding="utf-8", errors="replace")
        licence = next((line.strip()[:_LONGEST] for line in text.split("\n") if line.strip()), "")
    cite = asked.article or f"{GITHUB}/{asked.repository}"
    fetched = Fetched(asked.repository, place, commit, cite, licence, file, {}, importer=asked.importer)
    imported = dict[Path, Dataset]()
    for folder, asked_dataset in zip(folders, asked.datasets, strict=True):
        task = f"importing {asked_dataset.name}" if asked.importer else "importing"
        source = place / asked_dataset.path
        if not source.exists():
            raise DataError(f"{source} is not in commit {commit[:8]}; leave --commit out to take the one tested")
        report(Progress(task))
        try:
            if not asked.importer:
                fetched = replace(fetched, importer=recognised(source))
            # The importer's options hold origin and licence where they can, to be kept when it is imported again.
            origin = {"name": folder.resolve().name, "source": fetched.source, "licence": licence}
            fields = importers.entry(fetched.importer).options.model_fields
            given = {key: text for key, text in origin.items() if key in fields and text and text.isprintable()}
            dataset = import_dataset(fetched.importer, source, {**given, **asked_dataset.options})
            dataset = replace(dataset, source=fetched.source, licence=licence or dataset.licence)
            mistakes = () if asked.importer else search(recorded(dataset)).mistakes
            if wrong := [mistake.what for mistake in mistakes if mistake.kind in UNITS]:
                raise DataError("; ".join(wrong))
        except (ConfigError, DataError) as refusal:
            if asked.importer:
                raise
            return replace(fetched, refusal=str(refusal))
        finally:
            report(Progress(task, result=""))
        save_dataset(dataset, folder, overwrite=force)
        if file is not None:
            write_files({folder / file.name: file.read_bytes()})
        imported[folder] = dataset
    return replace(fetched, datasets=imported)


def _licence_file(folder: Path) -> Path | None:
    """The first file of a repository that holds its licence; None if it has none."""
    named = (file for file in sorted(folder.iterdir()) if _LICENCE.fullmatch(file.name.partition(".")[0]))
    return next((file for file in named if file.is_file()), None)
