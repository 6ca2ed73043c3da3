"""What can be replayed: data set folders, and the simulated data sets of comparison configs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from recordings import ROBOT, random_dataset

from omnibench.config import to_yaml
from omnibench.data.storage import save_dataset
from omnibench.errors import OmnibenchError
from omnibench.live.replay.concatenated_drive import load_recording
from omnibench.simulate.commands import Commands
from omnibench.simulate.config import FlowerConfig, Session, Truth
from omnibench.simulate.simulate import simulate_dataset

FLOWER = FlowerConfig(
    robot=ROBOT,
    commands=Commands(directions_deg=(0, 90), turn_rates=(0.1,)),
    repetitions=1,
    truth=Truth(published="palacin2023_eq8"),
    train=Session(seed=1, distance=0.1),
)


def config(tmp_path: Path, **datasets: object) -> Path:
    """A comparison's config with these data sets."""
    path = tmp_path / "compare.yaml"
    path.write_text(to_yaml({"name": "mine", "description": "Two runs.", "datasets": datasets, "calibrators": ["crs"]}))
    return path


def simulated(**changes: object) -> dict[str, object]:
    return {"simulate": FLOWER.model_dump(mode="json", exclude_none=True) | changes}


def test_a_folder_is_a_recording_without_a_truth(tmp_path: Path) -> None:
    dataset = random_dataset(1)
    save_dataset(dataset, tmp_path / "random")
    recording = load_recording(tmp_path / "random")
    assert recording.dataset.hash == dataset.hash
    assert recording.truth is None


def test_a_simulated_data_set_of_a_config_comes_with_its_truth(tmp_path: Path) -> None:
    recording = load_recording(config(tmp_path, flower=simulated()))
    expected = simulate_dataset(FLOWER, "flower", "Two runs.")
    assert recording.dataset.hash == expected.dataset.hash
    assert (recording.dataset.name, recording.dataset.description) == ("flower", "Two runs.")
    assert recording.truth == expected.truth


def test_one_of_several_can_be_chosen(tmp_path: Path) -> None:
    path = config(tmp_path, short=simulated(), long=simulated(train={"seed": 1, "distance": 0.2}), other={"path": "x"})
    longest = [load_recording(path, name).dataset.trajectories[0].times[-1] for name in ("short", "long")]
    np.testing.assert_allclose(longest, [0.5, 1.0])


def test_the_demonstrations_config_is_one() -> None:
    recording = load_recording(Path(__file__).resolve().parents[3] / "configs" / "apr02.yaml")
    assert len(recording.dataset.trajectories) == 360
    assert recording.truth is not None


class TestMistakes:
    def refusal(self, path: Path, dataset: str | None = None) -> str:
        with pytest.raises(OmnibenchError) as refused:
            load_recording(path, dataset)
        return str(refused.value)

    def test_a_path_without_anything_is_named(self, tmp_path: Path) -> None:
        assert self.refusal(tmp_path / "gone").endswith(
            "gone: no such file or folder; name a data set folder or a comparison's config"
        )

    def test_several_simulated_data_sets_need_a_choice(self, tmp_path: Path) -> None:
        path = config(tmp_path, one=simulated(), two=simulated())
        assert "several simulated data sets; choose one with --dataset: one, two" in self.refusal(path)

    def test_an_unknown_data_set_gets_the_nearest(self, tmp_path: Path) -> None:
        path = config(tmp_path, flower=simulated(), table=simulated())
        assert "unknown simulated data set 'flowr'; did you mean 'flower'?" in self.refusal(path, "flowr")

    def test_a_misspelt_key_of_the_simulation_gets_the_nearest(self, tmp_path: Path) -> None:
        path = config(tmp_path, flower=simulated(pose_perod=0.1))
        assert "unknown key 'datasets.flower.simulate.pose_perod'; did you mean 'pose_period'?" in self.refusal(path)

    def test_a_misspelt_source_gets_the_nearest(self, tmp_path: Path) -> None:
        path = config(tmp_path, flower={"simulat": {}})
        assert "unknown key 'datasets.flower.simulat'; did you mean 'simulate'?" in self.refusal(path)

    def test_a_data_set_that_is_not_simulated_says_what_to_name(self, tmp_path: Path) -> None:
        path = config(tmp_path, real={"path": "recordings"}, flower=simulated())
        assert "data set 'real' is not simulated; name its folder" in self.refusal(path, "real")

    def test_a_config_without_a_simulated_data_set_says_what_to_name(self, tmp_path: Path) -> None:
        path = config(tmp_path, real={"path": "recordings"})
        assert "no simulated data set in it; name the folder of a data set" in self.refusal(path)

    @pytest.mark.parametrize("content", ["", "12", "[1, 2]", yaml.dump({"wheels": 3})])
    def test_another_file_is_refused(self, tmp_path: Path, content: str) -> None:
        (tmp_path / "other.yaml").write_text(content)
        assert "no data sets in it; name a data set folder or" in self.refusal(tmp_path / "other.yaml")

    def test_a_broken_file_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "broken.yaml").write_text("datasets: [")
        assert "broken.yaml: not valid YAML" in self.refusal(tmp_path / "broken.yaml")

    def test_a_folder_has_no_data_sets_to_choose_from(self, tmp_path: Path) -> None:
        assert "is a folder with one data set; leave --dataset out" in self.refusal(tmp_path, "flower")
