"""The figures that the paper prints: those that omnibench holds and shows, and where the paper contradicts itself.

Palacin et al., Applied Sciences 13:1053 (2023). Figures in this file are copied from its pages.
"""

import math

import numpy as np
import pytest
import yaml
from commands import CONFIGS

from omnibench.cli.handbook_topics import find_topic
from omnibench.compare.config import CompareConfig, PublishedResult, read_compare_config
from omnibench.data.importers.table1 import APR_02
from omnibench.fit.parameterisation import make_bounds
from omnibench.robot.calibration import read_calibration
from omnibench.robot.kinematics import Array, published_matrix, relative_deviations
from omnibench.robot.physical import read_matrix

EQ_8 = """
-0.0892930568372762 -0.0005606566978203 0.0867466159313470
0.0520955668635434 -0.1010213675626970 0.0533117820461363
0.2364093797047320 0.2341358647406650 0.2353792947863630
"""
EQ_9 = """
-0.0883286476963123 0.0000000000000000 0.0873330402667908
0.0522829495809178 -0.1008246738469390 0.0536189007203205
0.2357044251338890 0.2338948216993490 0.2348793373133590
"""
EQ_11 = ["1.091", "1.505e15", "-0.671", "-0.358", "0.195", "-0.572", "0.299", "0.103", "0.212"]  # per cent
M12_IN_THE_TEXT = -1.208e-17  # of the non-parametric matrix, below Eq. (11)
SECTION_4_2 = [4.7, 2.4, 3.2, 12, 10, 11, 0.4, 0.2, 0.5]  # per cent: radii, distances, angles
# Label, costs and improvement in Table 2, the same in Table 3, seconds (sections 4.2 and 4.3).
TABLES = [
    ("Parametric IK [17]", (0.1234, 0.0215, "82.61"), (0.1251, 0.0229, "81.68"), 903),
    ("Non-parametric IK (GA)", (0.1234, 0.0215, "82.60"), (0.1251, 0.0227, "81.81"), 637),
]
WITH_TABLES = ["apr02.yaml", "apr02_robot.yaml", "apr02_floor.yaml"]


def printed(matrix: Array) -> list[str]:
    """Elements with 16 decimals, as the paper prints them."""
    return [f"{value:.16f}" for value in matrix.ravel()]


def cut_off(value: float, decimals: int = 3) -> str:
    """A number without the digits after the given decimals, which the paper does not round."""
    scale = 10**decimals
    return f"{math.trunc(value * scale) / scale:.{decimals}f}"


def apr02() -> CompareConfig:
    return read_compare_config(CONFIGS / "apr02.yaml")


def published(config: str) -> tuple[PublishedResult, ...]:
    return read_compare_config(CONFIGS / config).published_results


def said_of_the_paper() -> str:
    """All that the handbook and the config of the comparison say of the paper, on one line."""
    config = apr02()
    remarks = [remark for result in config.published_results for remark in result.remarks]
    return " ".join(" ".join([find_topic("paper").text, *config.notes, *remarks]).split())


@pytest.mark.parametrize(("name", "digits"), [("palacin2023_eq8", EQ_8), ("palacin2023_eq9", EQ_9)])
def test_the_published_matrices_have_every_printed_digit(name: str, digits: str) -> None:
    assert printed(published_matrix(name)) == digits.split()


def test_the_live_calibration_that_is_shipped_is_eq_9_and_runs_as_the_papers() -> None:
    calibration = read_calibration(CONFIGS / "apr02_calibration.yaml")
    assert printed(np.array(calibration.matrix)) == EQ_9.split()
    assert calibration.integration == "euler"  # Eq. (1), with which Eq. (9) was fitted


def test_eq_11_follows_from_eq_8_and_9_but_for_m12() -> None:
    shares = 100 * relative_deviations(published_matrix("palacin2023_eq8"), published_matrix("palacin2023_eq9")).ravel()
    assert math.isnan(shares[1])  # Eq. (9) prints m12 as 0
    assert [cut_off(shares[i]) for i in range(9) if i != 1] == [EQ_11[i] for i in range(9) if i != 1]


def test_m12_of_eq_11_contradicts_the_papers_own_text_and_this_is_said() -> None:
    share = 100 * (published_matrix("palacin2023_eq8")[0, 1] / M12_IN_THE_TEXT - 1)
    assert f"{share:.2e}" == "4.64e+15"
    assert float(EQ_11[1]) == pytest.approx(1.505e15)
    assert "4.64e15" in said_of_the_paper()


def test_no_geometry_of_eq_8_has_the_deviations_of_section_4_2_and_this_is_said() -> None:
    geometry = read_matrix(APR_02, published_matrix("palacin2023_eq8")).parameters
    deviations = np.array([each.deviation_percent for each in geometry])
    assert np.abs(np.abs(deviations) - SECTION_4_2).max() > 4
    radii, distances, angles = np.split(deviations, 3)
    words = (
        "{:+.1f}, {:+.1f} and {:+.1f} %".format(*radii),
        "{:+.1f}, {:+.1f} and {:+.1f} %".format(*distances),
        "{:+.1f}, {:+.1f} and {:.1f} %".format(*angles[:2], abs(angles[2])),
    )
    assert words == ("+3.4, +3.6 and +3.3 %", "+7.6, +14.6 and +11.5 %", "+1.0, +0.3 and 0.0 %")
    assert all(each in said_of_the_paper() for each in words)


@pytest.mark.parametrize("config", WITH_TABLES)
def test_published_rows_have_every_figure_of_tables_2_and_3(config: str) -> None:
    shown = [
        (
            result.label,
            (*result.costs("train"), f"{100 * result.improvement('train'):.2f}"),
            (*result.costs("validation"), f"{100 * result.improvement('validation'):.2f}"),
            result.seconds,
        )
        for result in published(config)
    ]
    assert shown == TABLES


@pytest.mark.parametrize(("before", "after", "share"), [row[part] for row in TABLES for part in (1, 2)])
def test_a_printed_improvement_is_one_that_costs_rounded_to_four_decimals_allow(
    before: float, after: float, share: str
) -> None:
    half = 0.00005
    least, most = 1 - (after + half) / (before - half), 1 - (after - half) / (before + half)
    assert least <= float(share) / 100 <= most
    assert f"{100 * (1 - after / before):.2f}" in said_of_the_paper()


@pytest.mark.parametrize("config", WITH_TABLES)
def test_published_times_stand_beside_entries_of_the_config_that_search_by_the_genetic_algorithm(config: str) -> None:
    entries = {entry.label or f"{entry.name}": entry for entry in read_compare_config(CONFIGS / config).calibrators}
    parametric, matrix = published(config)
    assert parametric.entry is not None
    assert entries[parametric.entry].options == {"search": "genetic"}
    assert matrix.entry in {"genetic", "genetic (paper box)"}


def test_the_true_matrix_of_apr02_lies_outside_the_papers_box_by_m12_alone_and_this_is_said() -> None:
    config = yaml.safe_load((CONFIGS / "apr02.yaml").read_text(encoding="utf-8"))
    truth = published_matrix(config["datasets"]["flower"]["simulate"]["truth"]["published"]).ravel()
    paper, row = make_bounds(APR_02, "paper"), make_bounds(APR_02, "row")
    outside = (truth < paper.lower) | (truth > paper.upper)
    assert np.flatnonzero(outside).tolist() == [1]
    assert ((truth > row.lower) & (truth < row.upper)).all()
    assert f"its m12 is {1e3 * truth[1]:.2f} mm/rad" in said_of_the_paper()
