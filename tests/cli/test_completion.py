"""Tab completion, as the shell asks for it: names of commands, options, and whatever an option or an argument names."""

from pathlib import Path

import pytest
from commands import ENVIRONMENT, ROOT, Command, python, succeeded

PROGRAM = "import sys; sys.argv[0] = 'omnibench'; from omnibench.__main__ import main; main()"


def line(typed: str) -> dict[str, str]:
    """How bash asks what to offer for the last word of a line."""
    return {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" ")), "_OMNIBENCH_COMPLETE": "complete_bash"}


@pytest.mark.parametrize(
    ("typed", "names"),
    [
        ("omnibench cal", {"calibrate"}),
        ("omnibench calibrate --para", {"--parameterisation"}),
        ("omnibench calibrate --calibrator cl", {"closed_form"}),
        ("omnibench calibrate --cost traj", {"trajectory"}),
        ("omnibench calibrate --box ", {"paper", "row"}),
        ("omnibench discover data --without heading_d", {"heading_drift"}),
        ("omnibench simulate --effect heading_d", {"heading_drift"}),
        ("omnibench exam make exam --effects heading_d", {"heading_drift"}),
        ("omnibench exam make exam --robots diff", {"differential"}),
        ("omnibench import ros", {"rosbag"}),
        ("omnibench check data --format ros", {"rosbag"}),
        ("omnibench export c.yaml --to c", {"c_header"}),
        ("omnibench fetch omni", {"omni3", "omni4"}),
        ("omnibench example sm", {"small"}),
        ("omnibench guide importi", {"importing"}),
        ("omnibench list eff", {"effects"}),
    ],
)
def test_a_name_is_completed(typed: str, names: set[str], command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in line(typed).items():
        monkeypatch.setenv(name, value)
    assert set(succeeded(command()).stdout.split()) == names


def test_no_plug_in_runs_while_somebody_types(tmp_path: Path) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "loud.py").write_text("raise SystemExit('it ran')\n", encoding="utf-8")
    asked = ENVIRONMENT | line("omnibench calibrate --calibrator ") | {"PYTHONPATH": str(ROOT)}
    assert "closed_form" in succeeded(python(PROGRAM, cwd=tmp_path, env=asked)).stdout.split()


def test_the_script_of_a_shell_is_shown(tmp_path: Path) -> None:
    shown = succeeded(python(PROGRAM, "--show-completion", cwd=tmp_path, env=ENVIRONMENT | {"SHELL": "/bin/bash"}))
    assert "_OMNIBENCH_COMPLETE=complete_bash" in shown.stdout
