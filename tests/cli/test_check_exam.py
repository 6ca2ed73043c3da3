"""The exam of `omnibench check`: its makers and judge, and a quick selection of its cases."""

from pathlib import Path

import pytest
from check_exam.exam import QUICK
from check_exam.faults import MAKERS, Damage
from check_exam.judging import applies, table
from check_exam.motion import misfit
from check_exam.recordings import DATA, NAMES
from check_exam.sitting import chosen_runs, generator, sit

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"the recordings are not at {DATA}")

_SEED = 1
# Faults that show in the motions, by the misfit of the design values' odometry.
_SHOWN = (
    "wheels_swapped", "wheel_negated", "wheels_negated", "wheel_scale", "wheel_unit", "steering_unit", "steering_sign",
    "heading_unit", "position_unit", "reference_mirrored", "reference_turned", "wheel_dead",
)  # fmt: skip


def damage_of(robot: str, kind: str) -> Damage:
    rng = generator(robot, kind, _SEED)
    return MAKERS[kind](chosen_runs(robot, kind, rng), rng)


def test_the_table_has_a_maker_for_every_kind_that_applies_to_a_robot() -> None:
    kinds = [kind for kind in table()["kinds"] if any(applies(kind, robot) for robot in NAMES)]
    assert sorted(kinds) == sorted(MAKERS)


@pytest.mark.slow
@pytest.mark.parametrize("kind", _SHOWN)
def test_a_fault_spoils_the_recording_of_every_robot_that_it_applies_to(kind: str) -> None:
    for robot in (robot for robot in NAMES if applies(kind, robot)):
        damage = damage_of(robot, kind)
        assert misfit(damage.recording) > 1.2 * misfit(damage.sound) + 0.01, (robot, damage.detail)


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "kind"), QUICK)
def test_check_finds_a_fault_and_its_fix_works(robot: str, kind: str, tmp_path: Path) -> None:
    result = sit(robot, kind, _SEED, tmp_path)
    assert result.found, result.reason
    assert result.fixed, result.reason
