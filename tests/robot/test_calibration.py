"""The calibration file, omnibench-calibration/1."""

import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import refused
from effect_samples import a_drive
from export_samples import DIFF, TRICYCLE, calibration
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02
from syrupy.assertion import SnapshotAssertion

from omnibench.config import to_yaml, validate
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.robot.calibration import (
    Calibration,
    EffectTerm,
    Noise,
    Provenance,
    covariance_rows,
    matrix_rows,
    read_calibration,
    write_calibration,
)
from omnibench.robot.kinematics import Mount, published_matrix
from omnibench.robot.physical import read_matrix

PROVENANCE = Provenance(
    dataset="flower",
    dataset_hash="0123abcd",
    fitted=("89abcdef01234567", "0123456701234567", "1234567812345678", "123456789012e456"),  # some look like numbers
    simulated=True,
    calibrator="closed_form",
    options={"tolerance": 1e-9, "programs": 50},
    seed=7,
    cost="final_pose",
    box="paper",
    versions={"numpy": "2.4.6"},
    training_cost=0.0215,
    validation_cost=0.0228,
    outcome="converged",
    reason="step below 1e-09 after 4 cone programs: done",
)
APR_MATRIX = published_matrix("palacin2023_eq8")


def a_calibration(**changes: Any) -> Calibration:
    given_values: dict[str, Any] = {
        "name": "flower closed_form",
        "robot": APR_02,
        "sample_period": 0.01,
        "matrix": matrix_rows(APR_MATRIX),
        "integration": "euler",
    }
    return Calibration(**(given_values | changes))


def broken(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A calibration file whose content was changed."""
    file = folder / "calibration.yaml"
    write_calibration(a_calibration(), file)
    content = yaml.safe_load(file.read_text())
    change(content)
    file.write_text(to_yaml(content))
    return file


number = st.floats(-1e3, 1e3)  # larger ones are refused
row = st.tuples(number, number, number)


@given(matrix=st.tuples(row, row, row).filter(np.any), period=st.floats(1e-6, 3600))
def test_matrix_and_period_keep_every_bit(tmp_path_factory: pytest.TempPathFactory, matrix: Any, period: float) -> None:
    file = tmp_path_factory.getbasetemp() / "bits.yaml"
    write_calibration(a_calibration(matrix=matrix, sample_period=period), file)
    found = read_calibration(file)
    assert found.matrix_array.tobytes() == np.array(matrix).tobytes()
    assert found.sample_period == period


def test_everything_in_a_calibration_comes_back(tmp_path: Path) -> None:
    covariance = np.random.default_rng(0).normal(size=(9, 9))
    written = a_calibration(
        integration="arc",
        created=datetime(2023, 1, 12, 13, 14, 15, tzinfo=UTC),
        noise=Noise(pose_position=0.0055, walk_heading=1 / 3),
        covariance=covariance_rows(covariance @ covariance.T),
        session="2023-01-12",
        provenance=PROVENANCE,
    )
    write_calibration(written, tmp_path / "calibration.yaml")
    assert read_calibration(tmp_path / "calibration.yaml") == written


def test_a_robot_that_steers_names_the_columns_of_its_matrix(tmp_path: Path) -> None:
    file, line = tmp_path / "tricycle.yaml", "signals: [front_cos, front_sin]\n"
    write_calibration(calibration(TRICYCLE), file)
    text, written = file.read_text(), read_calibration(file)
    assert line in text
    assert written.signals == ("front_cos", "front_sin")
    file.write_text(text.replace(line, ""))
    assert read_calibration(file) == written
    file.write_text(text.replace(line, "signals: [front_sin, front_cos]\n"))
    with pytest.raises(DataError, match="front_sin, front_cos"):
        read_calibration(file)
    write_calibration(a_calibration(), file)
    assert "signals" not in file.read_text()


TERMS = (
    EffectTerm(name="wheel_eccentricity", parameters={f"{part}_{wheel}": 1 / 300 for part in "ba" for wheel in "cab"}),
    EffectTerm(
        name="roller_ripple",
        parameters={f"{part}_{wheel}": 0.01 for part in "ab" for wheel in "abc"} | {"rollers": 9.0},
    ),
    EffectTerm(name="tyre_wear", parameters={"radius_2023-01-12": -0.001}),
    EffectTerm(name="reference_time_offset", parameters={"tau": 0.1}),
)


def test_effects_come_back_with_their_parameters_in_their_order_and_the_same_poses(tmp_path: Path) -> None:
    size = 9 + 6 + 7 + 1 + 1
    covariance = np.random.default_rng(0).normal(size=(size, size))
    written = a_calibration(effects=TERMS, covariance=covariance_rows(covariance @ covariance.T))
    write_calibration(written, tmp_path / "calibration.yaml")
    found, log = read_calibration(tmp_path / "calibration.yaml"), a_drive(1)
    assert found == written
    assert [list(term.parameters) for term in found.effects] == [list(term.parameters) for term in TERMS]
    np.testing.assert_array_equal(found.model.reported([log])[0], written.model.reported([log])[0])
    content = a_calibration(effects=TERMS).model_dump(mode="json") | {"covariance": np.eye(9).tolist()}
    with pytest.raises(ConfigError, match="24 x 24"):  # of the matrix, then of the effects
        validate(Calibration, content, "calibration.yaml")


def test_the_fingerprints_of_hundreds_of_fitted_runs_are_few_lines_of_the_file(tmp_path: Path) -> None:
    file, fitted = tmp_path / "calibration.yaml", tuple(f"{run:016x}" for run in range(360))
    provenance = PROVENANCE.model_copy(update={"fitted": fitted})
    write_calibration(a_calibration(provenance=provenance), file)
    assert read_calibration(file).provenance == provenance
    assert len(file.read_text().splitlines()) < 150
    file.write_text(file.read_text().replace(fitted[7], "run1"))
    with pytest.raises(DataError, match="fitted"):
        read_calibration(file)


def test_the_model_of_a_calibration_has_its_matrix_integration_and_effects() -> None:
    model = a_calibration(effects=TERMS, integration="arc").model
    assert [(term.name, dict(term.values)) for term in model.terms] == [(each.name, each.parameters) for each in TERMS]
    assert (model.sample_period, model.integration) == (0.01, "arc")
    assert [term.name for term in model.reference_terms] == ["reference_time_offset"]
    np.testing.assert_array_equal(model.matrix, published_matrix("palacin2023_eq8"))


def test_a_file_with_the_plain_matrix_comes_back_and_its_effects_fade(tmp_path: Path) -> None:
    slip = EffectTerm(name="centripetal_slip", parameters={"k": 0.05})
    covariance = covariance_rows(np.diag([1e-9] * 9 + [0.1**2]))
    shared = {"effects": (slip,), "covariance": covariance, "driven": ((0.01, 0.0, 0.0),)}
    fading, before = a_calibration(**shared, plain=matrix_rows(1.1 * APR_MATRIX)), a_calibration(**shared)
    write_calibration(fading, tmp_path / "calibration.yaml")
    again, log = read_calibration(tmp_path / "calibration.yaml"), a_drive(1)
    assert again == fading
    (poses,), (plain,) = again.model.poses([log]), a_calibration(matrix=fading.plain).model.poses([log])
    (whole,) = a_calibration(effects=(slip,)).model.poses([log])
    assert np.abs(poses - plain).max() < 0.1 * np.abs(whole - plain).max()
    write_calibration(before, tmp_path / "before.yaml")  # without it all stays as it was
    assert "plain" not in yaml.safe_load((tmp_path / "before.yaml").read_text())
    np.testing.assert_array_equal(before.model.poses([log])[0], whole)


def test_the_file_is_what_its_format_says(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    created = datetime(2023, 1, 12, 13, 14, 15, tzinfo=UTC)
    write_calibration(a_calibration(provenance=PROVENANCE, created=created), tmp_path / "calibration.yaml")
    assert (tmp_path / "calibration.yaml").read_text() == snapshot


def test_a_calibration_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    write_calibration(a_calibration(), file)
    before = file.read_text()
    (tmp_path / "a_file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        write_calibration(a_calibration(), tmp_path / "a_file" / "calibration.yaml")
    assert file.read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_file", "calibration.yaml"]


def put(key: str, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda content: content.update({key: value})


def rows(*lengths: int) -> list[list[float]]:
    return [[0.1] * length for length in lengths]


def effect(name: str, **parameters: float) -> Callable[[dict[str, Any]], object]:
    return put("effects", [{"name": name, "parameters": parameters}])


REFUSED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "an unknown key": (put("matrixx", 1), "'matrixx'; did you mean 'matrix'?"),
    "another format": (put("format", "omnibench-dataset/1"), "'omnibench-dataset/1'"),
    "no format": (lambda content: content.pop("format"), "'omnibench-calibration/1'"),
    "a missing key": (lambda content: content.pop("integration"), "'integration'"),
    "a row too short": (put("matrix", rows(3, 2, 3)), "row 2 of the matrix"),
    "a row too few": (put("matrix", rows(3, 3)), "'matrix.2'"),
    "a row too many": (put("matrix", rows(3, 3, 3, 3)), "matrix: "),
    "NaN in the matrix": (put("matrix", [[math.nan] * 3] * 3), "matrix.0.0: "),
    "an element that no wheel has": (put("matrix", [[1e6] * 3] * 3), "1e+06"),
    "text in the matrix": (put("matrix", [["x"] * 3] * 3), "matrix.0.0: "),
    "a matrix of zeros": (put("matrix", [[0.0] * 3] * 3), "zeros"),
    "a plain matrix of another shape": (put("plain", rows(3, 3, 4)), "row 3 of the plain matrix"),
    "a covariance of another shape": (put("covariance", rows(*[3] * 3)), "9 x 9"),
    "a covariance that is negative": (put("covariance", (-np.eye(9)).tolist()), "semi-definite"),
    "a covariance that is not symmetric": (put("covariance", np.triu(np.ones((9, 9))).tolist()), "symmetric"),
    "NaN in the noise": (put("noise", {"pose_position": math.nan}), "noise.pose_position: "),
    "negative noise": (put("noise", {"walk_heading": -0.1}), "noise.walk_heading: "),
    "noise of kilometres": (put("noise", {"walk_position": 1e200}), "noise.walk_position: "),
    "a period of hardly anything": (put("sample_period", 1e-300), "sample_period: "),
    "a period of centuries": (put("sample_period", 1e10), "sample_period: "),
    "an unknown integration": (put("integration", "runge_kutta"), "integration: "),
    "an unknown effect": (effect("centripetal_slipp"), "did you mean 'centripetal_slip'"),
    "an infinite parameter of an effect": (effect("centripetal_slip", k=math.inf), "effects.0.parameters.k: "),
    "an unknown parameter of an effect": (effect("heading_drift", b=0.001, bias=0.1), "unknown parameter 'bias'"),
    "a missing parameter of an effect": (effect("heading_drift"), "parameter 'b' (rad/s)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_is_wrong_is_refused_in_one_line_that_names_it(tmp_path: Path, case: str) -> None:
    change, words = REFUSED[case]
    file = broken(tmp_path, change)
    with refused(DataError, words, start=f"{file}: "):
        read_calibration(file)


@pytest.mark.parametrize("content", [None, b"", b"- a\n- b\n", b"just text", b"a: [1", b"\x89PNG\xff\xfe\x00\x01"])
def test_a_file_that_is_no_mapping_or_not_there_is_refused_in_one_line(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "calibration.yaml"
    if content is not None:
        file.write_bytes(content)
    with refused(DataError, str(file)):
        read_calibration(file)


def test_a_name_that_is_no_text_is_refused() -> None:
    with pytest.raises(ConfigError, match="name"):
        validate(Calibration, a_calibration().model_dump(mode="json") | {"name": "\ud800"}, "calibration.yaml")


def test_a_calibration_whose_effects_cannot_be_run_says_so_by_its_name() -> None:
    chosen = a_calibration().model_copy(update={"effects": (EffectTerm(name="heading_drift", parameters={"k": 0.1}),)})
    with pytest.raises(OmnibenchError, match="calibration 'flower closed_form': effect 'heading_drift'"):
        _ = chosen.model


# Physical parameters.


def test_parameters_stand_in_the_file_by_their_names_with_design_value_unit_and_interval(tmp_path: Path) -> None:
    named = {each.name: each for each in read_matrix(APR_02, APR_MATRIX, 1e-8 * np.eye(9), 5).parameters}
    write_calibration(a_calibration(parameters=named), tmp_path / "calibration.yaml")
    content = yaml.safe_load((tmp_path / "calibration.yaml").read_text())["parameters"]
    assert list(content) == [f"{kind}_{wheel}" for kind in ("radius", "distance", "angle") for wheel in "abc"]
    assert list(content["radius_a"]) == ["design", "value", "unit", "low", "high"]
    assert content["radius_a"]["low"] < content["radius_a"]["value"] < content["radius_a"]["high"]
    found = read_calibration(tmp_path / "calibration.yaml")
    assert found.parameters == named
    assert found.radius["a"] == named["radius_a"].value


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.update(unit="inch"), "unit"),
        (lambda content: content.update(value=float("nan")), "value"),
        (lambda content: content.update(sigma=0.1), "sigma"),
    ],
)
def test_a_parameter_that_is_none_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    parameter = {"design": 0.1, "value": 0.1, "unit": "m", "low": None, "high": None}
    change(parameter)
    file = broken(tmp_path, lambda content: content.update(parameters={"radius_a": parameter}))
    with pytest.raises(DataError, match=rf"parameters\.radius_a.*{words}"):
        read_calibration(file)


def test_a_file_without_parameters_has_them_by_its_matrix() -> None:
    old = a_calibration()
    assert old.parameters is None
    assert old.radius == pytest.approx({"a": 0.152968, "b": 0.153333, "c": 0.152941}, abs=1e-6)
    assert old.distance == pytest.approx({"a": 0.209806, "b": 0.223457, "c": 0.217368}, abs=1e-6)
    assert old.angle == pytest.approx({"a": 1.057446, "b": 3.149809, "c": 5.234812}, abs=1e-6)
    assert old.mount == Mount()
    fitted = a_calibration(provenance=PROVENANCE.model_copy(update={"mount": "fit"}))
    assert math.hypot(fitted.mount.x, fitted.mount.y) == pytest.approx(0.0078, abs=1e-4)


def test_the_numbers_of_two_wheels_and_of_a_tricycle_are_attributes() -> None:
    two = calibration(DIFF)
    assert two.track == pytest.approx(values_of(two)["track"])
    assert two.radius.keys() == {"left", "right"}
    assert two.mount == Mount()
    assert calibration(TRICYCLE).wheelbase == pytest.approx(values_of(calibration(TRICYCLE))["wheelbase"])


def values_of(shown: Calibration) -> dict[str, float]:
    return {name: each.value for name, each in shown.physical_parameters.items()}


@pytest.mark.parametrize(("name", "words"), [("track", "track"), ("wheelbase", "wheelbase")])
def test_what_a_robot_does_not_have_is_said(name: str, words: str) -> None:
    with pytest.raises(DataError, match=f"robot APR-02 has no {words}; it has radius_a, radius_b"):
        getattr(a_calibration(), name)
    with pytest.raises(DataError, match="robot diff has no distance; it has radius_right, radius_left, track"):
        _ = calibration(DIFF).distance
    with pytest.raises(DataError, match="no reading in physical parameters"):
        _ = a_calibration(matrix=matrix_rows(np.ones((3, 3)))).radius
