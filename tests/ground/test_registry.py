"""Names, and the classes behind them: built in, from files and from installed packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnibench.errors import ConfigError, PluginError, UnknownNameError, nearest
from omnibench.fit.calibrator import Calibrator, run_calibrator
from omnibench.registry import calibrators, load_plugin_file, load_plugins, registered_from
from omnibench.testing import synthetic_problem

PLUGIN = """
from pydantic import Field
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.registry import Options, calibrators


@calibrators.register("{name}")
class Still(Calibrator):
    '''Stays at the start.

    And more.
    '''

    class Options(Options):
        patience: int = Field(1, description="runs")

    def calibrate(self, problem):
        return Solution(problem.start, "stayed")
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "still.py").write_text(PLUGIN.format(name="still"))
    return tmp_path


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place on Python's path where packages can be put as an installer does."""
    place = tmp_path / "site-packages"
    place.mkdir()
    monkeypatch.syspath_prepend(place)
    return place


def install(place: Path, package: str, source: str, entry_points: str) -> None:
    (place / package).mkdir()
    (place / package / "__init__.py").touch()
    (place / package / "search.py").write_text(source)
    info = place / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)


def test_what_is_built_in_is_there_without_an_import() -> None:
    assert {"theoretical", "random_search"} <= {entry.name for entry in calibrators.entries()}
    assert calibrators.entry("theoretical").origin == "built in"
    assert calibrators.entry("theoretical").summary.startswith("The design values")


def test_an_unknown_name_gets_the_nearest_known_and_all_known() -> None:
    with pytest.raises(UnknownNameError) as failure:
        calibrators.create("theoretica", where="apr02.yaml: calibrators.0")
    message = str(failure.value)
    assert message.startswith("apr02.yaml: calibrators.0: unknown calibrator 'theoretica'; did you mean 'theoretical'?")
    assert "random_search" in message
    assert nearest("foo", ["robot", "dataset"]) == ""
    assert nearest("kz", ["kx", "robot"]) == "did you mean 'kx'? "


def test_an_unknown_option_and_one_of_the_wrong_size_are_named() -> None:
    with pytest.raises(ConfigError, match="'random_search': unknown key 'candidate'; did you mean 'candidates'"):
        calibrators.create("random_search", {"candidate": 3})
    with pytest.raises(ConfigError, match=r"'random_search': candidates: .*greater than 0 \(given: 0\)"):
        calibrators.create("random_search", {"candidates": 0})


def test_a_name_that_is_taken_is_refused() -> None:
    with pytest.raises(PluginError, match="calibrator 'theoretical' is registered already, by built in"):

        @calibrators.register("theoretical")
        class Another(Calibrator):
            """Would take the name."""


def test_a_file_is_loaded_with_its_options_summary_and_origin(folder: Path) -> None:
    assert load_plugins([folder], installed=False) == []
    entry = calibrators.entry("still")
    assert (entry.summary, entry.origin) == ("Stays at the start.", str((folder / "still.py").resolve()))
    assert list(entry.options.model_fields) == ["patience"]
    assert run_calibrator(calibrators.create("still"), synthetic_problem()).reason == "stayed"


def test_a_file_is_loaded_once_a_process_and_what_it_registered_can_be_asked(folder: Path) -> None:
    load_plugins([folder], installed=False)
    first = calibrators.entry("still").cls
    assert load_plugins([folder, folder], installed=False) == []
    assert calibrators.entry("still").cls is first
    ((found, entry),) = registered_from(folder / "still.py")
    assert (found.kind, entry.name) == ("calibrator", "still")


def test_tests_and_private_files_of_a_folder_are_not_plugins(folder: Path) -> None:
    for name in ("test_still.py", "_draft.py", "conftest.py"):
        (folder / name).write_text("raise RuntimeError('loaded')")
    assert load_plugins([folder], installed=False) == []


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("import nowhere_at_all", "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("raise ValueError('two\\nlines')", "ValueError: two lines"),
        ("def broken(:", "SyntaxError"),
        ("exit(1)", "SystemExit: 1"),
        (PLUGIN.format(name="theoretical"), "PluginError: calibrator 'theoretical' is registered already"),
    ],
)
def test_a_plugin_that_fails_is_named_and_the_others_are_loaded(source: str, error: str, folder: Path) -> None:
    (folder / "faulty.py").write_text(source)
    (failure,) = load_plugins([folder], installed=False)
    assert failure.origin == str((folder / "faulty.py").resolve())
    assert failure.error.startswith(error)
    assert "\n" not in failure.error
    assert calibrators.entry("still")
    assert calibrators.entry("theoretical").origin == "built in"


def test_a_plugin_that_fails_after_it_registered_leaves_nothing_behind(folder: Path) -> None:
    (folder / "half.py").write_text(PLUGIN.format(name="half") + "\nraise RuntimeError('later')\n")
    (failure,) = load_plugins([folder], installed=False)
    assert failure.error == "RuntimeError: later"
    with pytest.raises(UnknownNameError):
        calibrators.entry("half")


def test_two_plugins_of_one_name_name_the_first_one(folder: Path) -> None:
    (folder / "again.py").write_text(PLUGIN.format(name="still"))
    (failure,) = load_plugins([folder], installed=False)
    assert "calibrator 'still' is registered already, by" in failure.error
    assert "again.py" in failure.error
    assert calibrators.entry("still").origin == str((folder / "again.py").resolve())


def test_an_installed_package_is_found_by_its_entry_point(installed: Path) -> None:
    install(installed, "calmly", PLUGIN.format(name="calm"), "[omnibench.calibrators]\ncalm = calmly.search:Still\n")
    assert load_plugins() == []
    entry = calibrators.entry("calm")
    assert entry.origin == "calmly.search"
    assert run_calibrator(calibrators.create("calm"), synthetic_problem()).reason == "stayed"


def test_an_installed_package_that_fails_is_named_and_the_others_are_loaded(installed: Path) -> None:
    install(installed, "calmer", PLUGIN.format(name="calmer"), "[omnibench.calibrators]\nx = calmer.search\n")
    install(installed, "brittle", "raise OSError('no licence')", "[omnibench.importers]\nb = brittle.search:Reader\n")
    (failure,) = load_plugins()
    assert (failure.origin, failure.error) == ("omnibench.importers: brittle.search:Reader", "OSError: no licence")
    assert calibrators.entry("calmer").origin == "calmer.search"


def test_an_entry_point_of_something_else_is_left_alone(installed: Path) -> None:
    install(installed, "stranger", "raise OSError('loaded')", "[console_scripts]\nstranger = stranger.search:main\n")
    assert load_plugins() == []


def test_a_plugin_file_keeps_its_failure_when_it_is_asked_for_again(tmp_path: Path) -> None:
    (tmp_path / "faulty.py").write_text("raise ValueError('no')")
    first = load_plugin_file(tmp_path / "faulty.py")
    assert first is not None
    assert load_plugin_file(tmp_path / "faulty.py") == first
    with pytest.raises(PluginError, match="nowhere does not exist"):
        load_plugins([tmp_path / "nowhere"], installed=False)


def test_a_plugin_finds_names_where_they_were_before_modules_were_joined(folder: Path) -> None:
    before = (
        "from omnibench.robot.robot_class import class_of\nfrom omnibench.fit.differential.axle import TWO_WHEELS\n"
    )
    (folder / "old.py").write_text(before + PLUGIN.format(name="old"))
    assert load_plugin_file(folder / "old.py") is None
    (folder / "wrong.py").write_text("from omnibench.robot.robot_class import nothing_of_the_kind\n")
    assert "nothing_of_the_kind" in str(load_plugin_file(folder / "wrong.py"))
