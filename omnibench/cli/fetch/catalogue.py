"""Catalogue of public recordings, and the names by which a user asks for one."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omnibench.config import Model, read_model
from omnibench.errors import ConfigError, nearest

GITHUB = "https://github.com"

# GitHub's rules for names, and a repository's address where one is pasted.
_REPOSITORY = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]*/(?!\.{1,2}$)[A-Za-z0-9._][A-Za-z0-9._-]*")
_ADDRESS = re.compile(r"^(?:https?://)?(?:www\.)?github\.com/|\.git/?$|/$")


class PublicDataset(Model):
    """The recordings of one robot.

    path: of its file or folder in the repository. runs: kinds of motion that were driven. options: of the importer.
    """

    name: str
    path: str
    robot: str
    runs: str
    options: dict[str, Any] = {}


class PublicRecording(Model):
    """A GitHub repository with recordings.

    commit: that the import was tested with. reference: what measured the poses. article: to cite; empty: there is none.
    plugin: the file in ``plugins`` that registers the importer; empty: it is built in.
    """

    name: str
    repository: str
    commit: str
    licence: str
    reference: str
    article: str = ""
    importer: str
    plugin: str = ""
    datasets: tuple[PublicDataset, ...]


class _Catalogue(Model):
    recordings: tuple[PublicRecording, ...]


@dataclass(frozen=True)
class Asked:
    """A repository of GitHub, and what of it is wanted.

    recording: None for a repository that the catalogue does not hold; datasets is then empty.
    """

    repository: str
    recording: PublicRecording | None = None
    datasets: tuple[PublicDataset, ...] = ()


RECORDINGS = read_model(_Catalogue, Path(__file__).with_name("recordings.yaml")).recordings


def address(repository: str) -> str:
    """The address from which a repository is cloned."""
    return f"{GITHUB}/{repository}.git"


def find_recording(name: str) -> Asked:
    """The recording of a name: a recording, a data set, RECORDING/DATASET, or OWNER/REPO on GitHub.

    ConfigError names the nearest known name and lists all.
    """
    known: dict[str, Asked] = {}
    for recording in RECORDINGS:
        whole = Asked(recording.repository, recording, recording.datasets)
        for dataset in recording.datasets:
            one = Asked(recording.repository, recording, (dataset,))
            known |= {dataset.name: one, f"{recording.name}/{dataset.name}": one}
        known[recording.name] = whole
    if name in known:
        return known[name]
    repository = _ADDRESS.sub("", name)
    for recording in RECORDINGS:
        if repository.lower() == recording.repository.lower():
            return known[recording.name]
    owner = repository.partition("/")[0]
    if _REPOSITORY.fullmatch(repository) and owner not in {recording.name for recording in RECORDINGS}:
        return Asked(repository)
    short = [each for each in known if "/" not in each]
    raise ConfigError(
        f"fetch: unknown recording {name!r}; {nearest(name, known)}known: {', '.join(sorted(short))}, and any "
        "OWNER/REPO on GitHub"
    )
