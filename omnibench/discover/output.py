"""The folder of a discovery: discovery.json, report, calibrations, experiments, tables; written as a whole."""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import Field

from omnibench import files
from omnibench.config import Model, to_json, to_yaml
from omnibench.discover.report.discovery_report import discovery_report
from omnibench.discover.report.discovery_result import DiscoveryResult, residual_table
from omnibench.discover.result import CALIBRATION_FILES, Discovery, discovery_document, experiment_file
from omnibench.report.render import render
from omnibench.report.result import with_next_step

# First line of config.yaml: it tells a folder of results from one that happens to hold a file of that name.
_MARK = "# The effective options of a discovery; the results beside it were made with them."


class DiscoverOptions(Model):
    """The options of ``omnibench discover``, and the content of its config.yaml."""

    dataset: Path
    model: Path | None = Field(None, description="Start from this calibration. Default: fit a matrix.")
    without: tuple[str, ...] = Field((), description="Effect not to try; may be repeated.")
    unknown_term: bool = Field(
        True, description="Where no name is sure, close the gap all the same, by a term without a name."
    )
    seed: int = Field(0, ge=0, description="Seed of the random numbers.")
    plugins: tuple[Path, ...] = ()


def check_output(folder: Path | None, options: DiscoverOptions, *, force: bool = False) -> None:
    """Check the folder of results before the work.

    DataError: it is a file, or it holds anything but an earlier discovery with these options, and not ``force``.
    """
    if folder is not None:
        files.check_results_folder(folder, _config(options), "discovery with the same options", force=force)


def write_discovery(
    discovery: Discovery, options: DiscoverOptions, folder: Path | None = None, *, force: bool = False
) -> Path:
    """Write all files of a discovery and return their folder.

    Default: ``results/<data set name>/<time>``, with a link ``latest``. Raises DataError as ``check_output`` does, or
    if the folder cannot be written to; it is then left as it was.
    """
    chosen = folder or files.new_results_folder(
        files.RESULTS / (re.sub(r"[^A-Za-z0-9_.-]+", "_", discovery.dataset.name).strip("_.") or "dataset")
    )
    with files.results_locked(chosen):
        check_output(folder, options, force=force)
        shown = DiscoveryResult(discovery, chosen)
        texts = {
            "config.yaml": _config(options),
            "discovery.json": to_json(discovery_document(discovery, chosen)) + "\n",
            "report.html": render(with_next_step(discovery_report(discovery, to_yaml(options)), shown.next_step())),
            CALIBRATION_FILES["plain"]: to_yaml(discovery.plain),
        }
        if discovery.extends:
            texts[CALIBRATION_FILES["extended"]] = to_yaml(discovery.extended)
        texts |= _experiments(discovery)
        contents = {chosen / name: text.encode("utf-8") for name, text in texts.items()}
        contents[chosen / "residuals.parquet"] = files.encode_table(residual_table(discovery), "parquet")
        files.write_files(contents)
        for stale in chosen.glob("experiment-*.yaml"):  # files of an earlier discovery
            if stale.name not in _experiments(discovery):
                files.remove(stale)
        if not discovery.extends:
            files.remove(chosen / CALIBRATION_FILES["extended"])
    if folder is None:
        files.link_latest(chosen)
    return chosen


def _experiments(discovery: Discovery) -> dict[str, str]:
    """The configs of experiments by their files' names, without those that have none."""
    return {experiment_file(number): each.config for number, each in enumerate(discovery.experiments, 1) if each.config}


def _config(options: DiscoverOptions) -> str:
    """The content of config.yaml."""
    return f"{_MARK}\n{to_yaml(options)}"
