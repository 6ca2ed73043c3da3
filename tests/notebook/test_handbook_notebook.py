"""The notebook of the handbook: every cell runs, in order, as Jupyter runs it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from timing import PATIENCE

from omnibench.cli.handbook_topics import HANDBOOK
from omnibench.robot.calibration import read_calibration

NOTEBOOKS = sorted((HANDBOOK / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_runs_and_finds_the_robot(file: Path, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook: Any = nbformat.read(file, as_version=4)
    nbclient.NotebookClient(notebook, timeout=int(PATIENCE), resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [set(output["data"]) for cell in notebook.cells for output in cell.get("outputs", ()) if "data" in output]
    assert sum("application/vnd.plotly.v1+json" in kinds for kinds in shown) == 4
    assert sum("text/html" in kinds for kinds in shown) >= 3
    matrix = read_calibration(tmp_path / "cart.yaml").matrix_array
    assert matrix[0, 0] == pytest.approx(0.0510 / 2, rel=0.01)
    assert matrix[0, 1] == pytest.approx(0.0485 / 2, rel=0.01)


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_is_kept_without_outputs(file: Path) -> None:
    content = json.loads(file.read_text(encoding="utf-8"))
    assert len(file.read_bytes()) < 20_000
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in content["cells"])
