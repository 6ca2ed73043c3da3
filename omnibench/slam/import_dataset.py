"""Import of recordings as a data set, with reference poses from the laser scans of recordings that hold none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Imported
from omnibench.data.importers.dataset_folder import importer_of, read_dataset
from omnibench.files import check_source
from omnibench.slam.slam_options import SlamOptions


def import_dataset(name: str, source: Path | str, options: Mapping[str, Any] | None = None) -> Dataset:
    """Read ``source`` with the importer called ``name``; recordings without reference poses get them by SLAM.

    options: the importer's, with those of SLAM under ``slam`` where the importer reads scans; or those of ``import
    dataset`` that the importer does not have, as if its data set was imported again. UnknownNameError, ConfigError or
    DataError in one line.
    """
    source = Path(source)
    check_source(source)
    importer, again = importer_of(name, source, options or {})
    slam = validate(SlamOptions, getattr(importer.options, "slam", {}), f"importer {name!r}: slam")
    recorded = dataset = read_dataset(importer, source, again)
    if not recorded.referenced:
        from omnibench.slam.slam_dataset import slam_dataset  # small_gicp and numba, which other recordings do without

        made = f"{source}: reference poses were made from the scans by SLAM, because the recording holds none"
        dataset = slam_dataset(recorded, slam)
        dataset = replace(dataset, warnings=(*recorded.warnings, made, *dataset.warnings))
    return replace(dataset, imported=Imported.of(name, source, options or {}))
