"""omnibench installed from a wheel does its main job in an empty folder, where no clone is."""

import os
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from commands import ROOT
from timing import PATIENCE

pytestmark = pytest.mark.slow
Run = Callable[..., str]

# Shortens the example's comparison; calibrators of the plug-ins that the example brings are among those that stay.
SHORT = {
    "seeds": [1],
    "budget": {"evaluations": 500, "seconds": 60},
    "calibrators": ["theoretical", "closed_form", "cmaes", "maddahi"],
    "bootstrap": {"resamples": 200},
    "certificate": None,
    "workers": 1,
}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh virtual environment with the wheel; only the dependencies are those of this environment."""
    folder = tmp_path_factory.mktemp("wheel")
    packages = sysconfig.get_path("purelib")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True, timeout=PATIENCE)
    isolation = ["--no-build-isolation"] if find_spec("hatchling") else []  # else pip fetches what the build needs
    subprocess.run([*pip, "wheel", "--no-deps", *isolation, "-w", folder, ROOT], check=True, timeout=300)
    wheel = next(folder.glob("omnibench-*.whl"))
    into = ["--python", folder / "venv" / "bin" / "python"]
    subprocess.run([*pip, *into, "install", "--no-deps", "--no-index", wheel], check=True, timeout=PATIENCE)
    library = next((folder / "venv" / "lib").glob("python*")) / "site-packages"
    (library / "dependencies.pth").write_text(f"{packages}\n", encoding="utf-8")
    return folder / "venv"


@pytest.fixture
def run(installed: Path, tmp_path: Path) -> Run:
    """A program of the environment, in an empty folder; what it printed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["OMP_NUM_THREADS"] = "1"

    def run(program: str, *arguments: str) -> str:
        ended = subprocess.run(
            [installed / "bin" / program, *arguments],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    return run


def test_the_wheel_and_no_clone_is_imported(run: Run, installed: Path) -> None:
    place = run("python", "-c", "import omnibench; print(omnibench.__file__)")
    assert Path(place.strip()).is_relative_to(installed)


def test_the_papers_comparison_runs_from_a_wheel_to_its_report(run: Run, tmp_path: Path) -> None:
    run("omnibench", "example", "apr02", "-o", ".")
    config = tmp_path / "configs" / "apr02.yaml"
    content = yaml.safe_load(config.read_text(encoding="utf-8")) | SHORT
    content["datasets"]["flower"]["simulate"] |= {"repetitions": 1, "sample_period": 0.05}
    config.write_text(yaml.safe_dump(content), encoding="utf-8")
    assert "cmaes" in run("omnibench", "compare", "configs/apr02.yaml", "--output", "out")
    assert (tmp_path / "out" / "report.html").stat().st_size > 100_000


def test_the_handbook_is_in_the_wheel(run: Run) -> None:
    assert run("omnibench", "guide", "getting-started").startswith("# ")
