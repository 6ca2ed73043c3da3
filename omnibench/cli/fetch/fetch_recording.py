"""Fetching of a public recording: a clone of its GitHub repository, imported as data sets."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omnibench.cli.examples import bundled_folder
from omnibench.cli.fetch.catalogue import GITHUB, Asked, PublicRecording, find_recording
from omnibench.cli.fetch.clone import NEWEST, Clone, open_clone
from omnibench.data.checks.finding import FindingWarning
from omnibench.data.dataset import Dataset
from omnibench.data.storage import check_dataset_folder, save_dataset
from omnibench.errors import ConfigError, DataError, PluginError
from omnibench.files import refuse_existing, write_files
from omnibench.fit.check.recording_source import recognised
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import importers, load_plugin_file
from omnibench.slam.import_dataset import import_dataset

CLONES = Path("clones")  # where clones are kept, as OWNER/REPO
DATA = Path("data")  # where data sets go, where the user names no folder

_LICENCE = re.compile(r"(?:un)?licen[cs]e|copying", re.IGNORECASE)
_LONGEST = 80  # characters of a licence's title; chosen


@dataclass(frozen=True)
class Fetched:
    """A public recording on this disk.

    cite: the article, or else the repository. licence: as the data sets say it, empty if it is not known. licence_file:
    its text in the clone. datasets: by their folders. refusal: why nothing was imported; importer: that was tried.
    """

    clone: Clone
    cite: str
    licence: str
    licence_file: Path | None
    datasets: Mapping[Path, Dataset]
    refusal: str = ""
    importer: str = ""

    @property
    def source(self) -> str:
        """The origin, as the data sets say it."""
        return f"public GitHub repository {self.clone.repository}, commit {self.clone.commit}"


def fetch_recording(
    name: str,
    output: Path | None = None,
    *,
    commit: str | None = None,
    force: bool = False,
    clones: Path = CLONES,
    report: Reporter = no_progress,
) -> Fetched:
    """Clone a public recording into ``clones`` and import it; a clone that is there is used again.

    name: of the catalogue, or OWNER/REPO on GitHub, which is imported where its format is recognised. output: folder of
    the data set, or of several data sets. commit: to check out, ``HEAD`` for the newest; default: the one tested, or
    the newest. force: replace data sets that are there. ConfigError, DataError or PluginError in one line.
    """
    asked = find_recording(name)
    folders = _folders(asked, output)
    for folder in folders:
        check_dataset_folder(folder)
    refuse_existing(*folders, force=force, folders=True)
    default = asked.recording.commit if asked.recording else NEWEST
    clone = open_clone(asked.repository, clones / asked.repository, commit or default, report)
    if asked.recording is None:
        return _unknown(clone, folders[0], force, report)
    return _known(clone, asked, asked.recording, folders, force, report)


def _folders(asked: Asked, output: Path | None) -> list[Path]:
    """The folders of the data sets: the one that was named, or one below it for each of several."""
    names = [dataset.name for dataset in asked.datasets] or [asked.repository.partition("/")[2]]
    if output is not None and len(names) == 1:
        return [output]
    return [(output or DATA) / name for name in names]


def _known(
    clone: Clone, asked: Asked, recording: PublicRecording, folders: list[Path], force: bool, report: Reporter
) -> Fetched:
    """The data sets of a recording of the catalogue."""
    _provide(recording)
    cite = recording.article or f"{GITHUB}/{clone.repository}"
    fetched = Fetched(clone, cite, recording.licence, _licence_file(clone.folder), {})
    datasets = {}
    for folder, wanted in zip(folders, asked.datasets, strict=True):
        source = clone.folder / wanted.path
        if not source.exists():
            raise DataError(f"{source} is not in commit {clone.commit[:8]}; leave --commit out to take the one tested")
        report(Progress(f"importing {wanted.name}"))
        datasets[folder] = _imported(fetched, recording.importer, source, folder, wanted.options)
        _save(fetched, datasets[folder], folder, force)
        report(Progress(f"importing {wanted.name}", result=""))
    return replace(fetched, datasets=datasets)


def _unknown(clone: Clone, folder: Path, force: bool, report: Reporter) -> Fetched:
    """The data set of any other repository, if its format is recognised; else why nothing was imported."""
    file = _licence_file(clone.folder)
    fetched = Fetched(clone, f"{GITHUB}/{clone.repository}", _title(file), file, {})
    report(Progress("importing"))
    try:
        fetched = replace(fetched, importer=recognised(clone.folder))
        dataset = _imported(fetched, fetched.importer, clone.folder, folder, {})
        wrong = [each for each in dataset.warnings if isinstance(each, FindingWarning) and each.unit]
        if wrong:
            raise DataError("; ".join(wrong))
    except (ConfigError, DataError) as refused:
        return replace(fetched, refusal=str(refused))
    finally:
        report(Progress("importing", result=""))
    _save(fetched, dataset, folder, force)
    return replace(fetched, datasets={folder: dataset})


def _provide(recording: PublicRecording) -> None:
    """Load the plug-in with a recording's importer, unless one of that name is there. PluginError: it fails."""
    if recording.plugin and recording.importer not in [entry.name for entry in importers.entries()]:
        failure = load_plugin_file(bundled_folder() / "plugins" / recording.plugin)
        if failure is not None:
            raise PluginError(f"plug-in {failure.origin} cannot be imported: {failure.error}")


def _imported(fetched: Fetched, importer: str, source: Path, folder: Path, options: Mapping[str, Any]) -> Dataset:
    """A data set that says its origin and licence. The importer's options hold them where they can, to be kept when
    the recording is imported again."""
    fields = importers.entry(importer).options.model_fields
    said = {"name": folder.resolve().name, "source": fetched.source, "licence": fetched.licence}
    given = {key: text for key, text in said.items() if key in fields and text and text.isprintable()}
    dataset = import_dataset(importer, source, {**given, **options})
    return replace(dataset, source=fetched.source, licence=fetched.licence or dataset.licence)


def _save(fetched: Fetched, dataset: Dataset, folder: Path, force: bool) -> None:
    """Write a data set with the text of its licence."""
    save_dataset(dataset, folder, overwrite=force)
    if fetched.licence_file is not None:
        write_files({folder / fetched.licence_file.name: fetched.licence_file.read_bytes()})


def _licence_file(folder: Path) -> Path | None:
    """The first file of a repository that holds its licence; None if it has none."""
    named = (file for file in sorted(folder.iterdir()) if _LICENCE.fullmatch(file.name.partition(".")[0]))
    return next((file for file in named if file.is_file()), None)


def _title(file: Path | None) -> str:
    """The first line of a licence's text, which is its title."""
    if file is None:
        return ""
    lines = file.read_text(encoding="utf-8", errors="replace").split("\n")
    return next((line.strip()[:_LONGEST] for line in lines if line.strip()), "")
