"""Reading YAML: one line for a mistake, with its place and the nearest key, and effective copies that lose nothing."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import Field, model_validator

from omnibench.config import Model, parse_settings, parse_yaml, read_model, read_yaml, to_yaml, validate
from omnibench.errors import ConfigError


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
    def _few_wheels(self) -> Robot:
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
        ("just words\n", ["expected keys and values"]),
        ("42\n", ["expected keys and values"]),
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


def test_the_same_key_in_two_mappings_is_no_repetition(written) -> None:
    assert len(read_model(Robot, written("title: x\nwheels: [{radius: 1}, {radius: 2}]\n")).wheels) == 2


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
    ],
)
def test_a_number_is_a_number_however_it_is_written(text: str, value: float, written) -> None:
    found = read_yaml(written(f"value: {text}\n"))["value"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("text", ["e6", "1e", "run-1e", "221220201643_run", "1-2"])
def test_words_with_digits_stay_words(text: str, written) -> None:
    assert read_yaml(written(f"value: {text}\n")) == {"value": text}


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
