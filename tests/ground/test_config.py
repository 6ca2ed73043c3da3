"""Configs, registries and files, and what is refused of them in one line."""

import errno
import os
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import Field, model_validator

from omnibench.config import Model, parse_settings, parse_yaml, read_model, read_yaml, to_yaml, validate
from omnibench.errors import ConfigError, DataError, PluginError, UnknownNameError, nearest, one_line, visible
from omnibench.files import check_results_folder, link_latest, new_results_folder, replacing, results_locked, write_text
from omnibench.fit.calibrator import run_calibrator
from omnibench.registry import calibrators, load_plugin_file, load_plugins, registered_from
from omnibench.testing import synthetic_problem


class Wheel(Model):
    radius: float = Field(gt=0)
    name: str = "a"


class Circle(Model):
    shape: Literal["circle"] = "circle"
    diameter: float = 1.0


class Square(Model):
    side: float = 1.0


class Robot(Model):
    title: str
    wheels: tuple[Wheel, ...] = ()
    speeds: dict[str, Wheel] = Field({})
    outline: Circle | Square | None = None
    mode: Literal["euler", "arc"] = "arc"

    @model_validator(mode="after")
    def _few_wheels(self) -> Self:
        if len(self.wheels) > 3:
            raise ValueError(f"{len(self.wheels)} wheels are too many")
        return self


@pytest.fixture
def written(tmp_path: Path):
    def write(text: str) -> Path:
        (tmp_path / "robot.yaml").write_text(text, encoding="utf-8")
        return tmp_path / "robot.yaml"

    return write


def complaint(path: Path) -> str:
    """What reading ``path`` as a robot says, without the file in front."""
    with pytest.raises(ConfigError) as failure:
        read_model(Robot, path)
    message = str(failure.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("titel: x\n", ["'titel'", "did you mean 'title'?", "mode, ", "(and 1 more mistake)"]),
        ("titel: x\nspeed: 1\n", ["'titel'", "(and 2 more mistakes)"]),
        ("title: x\nwheels: [{radius: 1}, {radius: 1, nmae: b}]\n", ["'wheels.1.nmae'", "'name'", "name, radius"]),
        ("title: x\nspeeds: {fast: {radius: 1, raduis: 2}}\n", ["'speeds.fast.raduis'", "'radius'", "name, radius"]),
        ("title: x\noutline: {diametre: 2}\n", ["'diameter'", "diameter, shape, side"]),
        ("title: x\nqqq: 1\n", ["unknown key 'qqq'; known: mode, outline, speeds, title, wheels"]),
        ("title: x\nwheels: [{name: b}]\n", ["'wheels.0.radius' is missing"]),
        ("title: x\nwheels: [{radius: wide}]\n", ["wheels.0.radius: ", "(given: 'wide')"]),
        ("title: x\nwheels: [{radius: -1}]\n", ["wheels.0.radius: ", "greater than 0 (given: -1)"]),
        ("title: x\nmode: exact\n", ["mode: ", "'euler' or 'arc' (given: 'exact')"]),
        ("title: x\nwheels: [{radius: 1}, {radius: 1}, {radius: 1}, {radius: 1}]\n", ["4 wheels are too many"]),
        ("- title: x\n- title: y\n", ["expected keys and values"]),
        ("title: x\nspeeds: [1, 2]\n", ["speeds: "]),
        ("title: x\nwheels: {radius: 1}\n", ["wheels: "]),
        ("", ["is empty", "'title'"]),
        ("title: x\nmode: arc\ntitle: y\n", ["line 3: key 'title' is given twice"]),
        ("title: x\nwheels:\n- radius: 1\n  radius: 2\n", ["line 4: key 'radius' is given twice"]),
        ("title: [x\nmode: {", ["not valid YAML: "]),
        ("title: !!python/object/apply:os.getcwd []\n", ["not valid YAML: "]),
    ],
)
def test_a_mistake_is_one_line_with_its_place_and_the_nearest_key(text: str, parts: list[str], written) -> None:
    found = complaint(written(text))
    for part in parts:
        assert part in found


def test_what_cannot_be_read_as_a_file_is_refused(tmp_path: Path) -> None:
    assert complaint(tmp_path / "nowhere.yaml") == "no such file"
    assert complaint(tmp_path).startswith("is a folder")
    (tmp_path / "robot.yaml").write_bytes(b"\xff\xfe\x00")
    assert complaint(tmp_path / "robot.yaml").startswith("cannot be read: ")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-6", 1e-6),
        ("1E6", 1e6),
        ("-2.5e+3", -2500.0),
        ("+.5", 0.5),
        ("1.", 1.0),
        (".inf", np.inf),
        ("12", 12),
        ("0.1", 0.1),
        *((word, word) for word in ("e6", "1e", "run-1e", "221220201643_run", "1-2")),
    ],
)
def test_numbers_are_numbers_however_they_are_written_and_words_stay_words(text: str, value: Any, written) -> None:
    found = read_yaml(written(f"value: {text}\n"))["value"]
    assert found == value
    assert type(found) is type(value)


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_floats_come_back_to_the_last_bit(values: list[float]) -> None:
    class Numbers(Model):
        values: tuple[float, ...]

    assert validated(Numbers, Numbers(values=tuple(values))).values == tuple(values)


@example(text="0E0")
@given(st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc"))))
def test_texts_come_back_as_they_were(text: str) -> None:
    class Words(Model):
        text: str

    assert validated(Words, Words(text=text)).text == text


def test_a_document_comes_back_as_it_was_with_every_default_spelt_out() -> None:
    robot = Robot(title="x", wheels=(Wheel(radius=0.1),), outline=Square(side=2.0))
    text = to_yaml(robot)
    assert "mode: arc" in text
    assert validated(Robot, robot) == robot


def test_numpy_numbers_and_tuples_are_written_plainly() -> None:
    assert to_yaml({"values": (1.5, float(np.float64(2.5)))}) == "values: [1.5, 2.5]\n"


def test_a_model_does_not_change() -> None:
    wheel: Any = Wheel(radius=1.0)  # whose type would forbid the assignment, too
    with pytest.raises(ValueError, match="frozen"):
        wheel.radius = 2.0


def test_what_is_wrong_outside_a_file_gets_the_place_that_is_given() -> None:
    with pytest.raises(ConfigError, match=r"^apr02\.yaml: budget: key 'title' is missing$"):
        validate(Robot, {}, "apr02.yaml: budget")


def validated(model: type[Model], document: Model) -> Model:
    """``document`` written and read again."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "document.yaml"
        file.write_text(to_yaml(document), encoding="utf-8")
        return read_model(model, file)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a [1]\nb: *a", "line 2: aliases"),
        ("a: {<<: {x: 1}}", "line 1: merge keys"),
        ("a: !!str 5", "line 1: tags such as !!str"),
        ("%YAML 1.1\n---\na: 1", "directives such as %YAML"),
        ("%YAML 1.3\n---\na: 1", "line 1: found incompatible YAML document"),
        ("a: 1\n---\nb: 2", "line 2: a second document"),
        ("? [1]\n: 2", "line 1: a key is a list"),
        (r'a: "\ud800"', "line 1: found invalid Unicode"),
        ("- " * 40 + "x", "line 1: nested too deeply"),
        ("[" + "1, " * 100 + "]", "more than 90 values"),
    ],
)
def test_yaml_that_means_more_than_it_shows_is_refused(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=rf"^file: not valid YAML: {words}"):
        parse_yaml(text, "file", 90)


@pytest.mark.parametrize(
    "digits", ["9" * 5000, "0x" + "f" * 5000, ":".join(["1"] * 40_000)], ids=["decimal", "hexadecimal", "of base 60"]
)
def test_a_number_too_long_to_be_converted_quickly_is_text(digits: str) -> None:
    assert parse_yaml(f"a: {digits}", "file") == {"a": digits}


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([1] * 100_000, "[1, 1, 1, 1, 1, 1, ...]"),
        ([["x" * 99] * 9] * 9, "list of 9"),
        (2**50_000, "a whole number of more than 60 digits"),
        ("x" * 100_000, "'" + "x" * 27 + "..." + "x" * 28 + "'"),
    ],
    ids=["a list", "lists of texts", "a number", "a text"],
)
def test_a_refused_value_is_never_shown_whole(value: Any, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        validate(Circle, {"diameter": value}, "file")
    assert str(refused.value).endswith(f"(given: {words})")


@pytest.mark.parametrize("pattern", ["*_1", "[0-4]*", "!x*", "@x*", " *_1", "&x"])
def test_a_pattern_of_names_needs_no_quotes_on_the_command_line(pattern: str) -> None:
    assert parse_settings([f"validation={pattern}", "n=[1, 2]"]) == {"validation": pattern, "n": [1, 2]}


# Names, and the classes behind them: built in, from files and from installed packages.

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


# What the plug-ins of 2d6fdb9 imported from modules that have been joined since
MOVED = """
from omnibench.data.alignment import median_period
from omnibench.data.splits import Names, divided, every_second
from omnibench.fit.differential.axle import TWO_WHEELS, axle_length, has_two_wheels, with_axle
from omnibench.fit.differential.driven_squares import Square, squares_both_ways
from omnibench.fit.observations.motion_windows import MotionWindows, motions_in_windows
from omnibench.fit.shrinkage.shrunk_matrix import closed_form_result, shrunk_closed_form
from omnibench.fit.uncertainty.uncertainty import NoCovarianceError, uncertainty_of
from omnibench.robot.domain.fade import GROWTH
from omnibench.robot.domain.training_domain import motions_of, representatives
from omnibench.robot.effects.learned.network import Network
from omnibench.robot.effects.weights import encode_weights
from omnibench.robot.odometry import Complex, chord_shares
from omnibench.robot.planar import relative
from omnibench.robot.robot_class import RobotClass, class_of
from omnibench.robot.signals import of_centre
"""


def test_a_plugin_finds_names_where_they_were_before_modules_were_joined(folder: Path) -> None:
    (folder / "old.py").write_text(MOVED + PLUGIN.format(name="old"))
    assert load_plugin_file(folder / "old.py") is None
    (folder / "wrong.py").write_text("from omnibench.robot.robot_class import nothing_of_the_kind\n")
    assert "nothing_of_the_kind" in str(load_plugin_file(folder / "wrong.py"))


# Files are written whole or not at all, devices and pipes are never replaced, and foreign folders are refused.


def test_a_link_goes_on_pointing_to_the_file_that_is_written(tmp_path: Path) -> None:
    (tmp_path / "file.yaml").write_text("old")
    (tmp_path / "link.yaml").symlink_to("file.yaml")
    write_text(tmp_path / "link.yaml", "new")
    assert (tmp_path / "link.yaml").is_symlink()
    assert (tmp_path / "file.yaml").read_text() == "new"


def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_text(pipe, "through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_full_device_is_one_line(tmp_path: Path) -> None:
    device = tmp_path / "full"
    try:
        os.mknod(device, stat.S_IFCHR | 0o600, os.makedev(1, 7))  # as /dev/full, but not the system's own
        device.write_text("x")
    except PermissionError:
        pytest.skip("devices cannot be made here")
    except OSError:
        with pytest.raises(DataError, match="No space left on device; free space or choose another place"):
            write_text(device, "x")
        assert stat.S_ISCHR(device.stat().st_mode)
    else:
        pytest.fail("the device took what it was given")


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EISDIR, "is a folder; name a file"),
        (errno.ENOSPC, "No space left on device; free space"),
        (errno.EACCES, "Permission denied; get permission"),
        (errno.EROFS, "Read-only file system; choose another place"),
    ],
)
def test_the_advice_fits_what_the_disk_refuses(number: int, words: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"cannot be written: {words}"), replacing(tmp_path / "x"):
        raise OSError(number, os.strerror(number))


def test_a_text_from_anywhere_becomes_one_line_that_can_be_written_and_controls_no_terminal(tmp_path: Path) -> None:
    line = one_line("a\nb\x1b[31m\ud800 \u202ec\u3000d\u00a0e")
    assert line == "a b?[31m? ?c d e"
    assert visible("a\u3000b\u200dc\nd\x07") == "a\u3000b\u200dc\nd?"
    write_text(tmp_path / "reason", line)


def test_a_link_that_cannot_be_made_is_left_out(tmp_path: Path) -> None:
    folder = new_results_folder(tmp_path)
    (tmp_path / "latest").mkdir()
    link_latest(folder)
    assert {path.name for path in tmp_path.iterdir()} == {folder.name, "latest"}


@pytest.mark.parametrize("content", [b"seed: 1\n", b"\xff\xfe"])
def test_a_folder_with_other_files_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(DataError, match=r"holds other files; name a new folder, or one of an earlier trial"):
        check_results_folder(tmp_path, "# ours", "trial")


def test_a_folder_of_results_is_free_again_when_the_process_that_wrote_there_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    writes = (
        "import sys, time\nfrom pathlib import Path\nfrom omnibench.files import results_locked\n"
        "with results_locked(Path(sys.argv[1])):\n    print(flush=True)\n    time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", writes, str(folder)], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        refusal = f"^{folder}: another omnibench is writing results there; name another folder"
        with pytest.raises(DataError, match=refusal), results_locked(folder):
            pass
        process.kill()
    with results_locked(folder):
        assert list(folder.iterdir()) == []


def test_an_empty_folder_of_results_goes_while_it_is_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there: list[bool] = []
    close = os.close
    monkeypatch.setattr(os, "close", lambda lock: (there.append((tmp_path / "new").exists()), close(lock)))
    with results_locked(tmp_path / "new"):
        pass
    assert there == [False]


def test_a_file_is_on_the_disk_before_it_replaces_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[str, str]] = []

    def sync(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        calls.append((path.name.partition(".")[2].partition(".")[0], (tmp_path / "state.yaml").read_text()))

    monkeypatch.setattr(os, "fsync", sync)
    write_text(tmp_path / "state.yaml", "old")
    assert calls == []
    write_text(tmp_path / "state.yaml", "new")
    assert calls == [("state", "old"), ("", "new")]
