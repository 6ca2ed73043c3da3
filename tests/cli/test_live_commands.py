"""The commands of the live runtime, as a user types them."""

import json
import re
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
import zenoh
from commands import CONFIGS, assert_refused, flower, omnibench, prepare, succeeded, write_config
from commands import Command as InProcess
from drives import calibration
from nodes import Command, asked, connected, write_node
from sessions import Loopback, free_port, until
from timing import load

from omnibench.data.storage import load_dataset
from omnibench.live.wire import JOINT_STATE, ODOMETRY, JointState
from omnibench.robot.calibration import read_calibration, write_calibration


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated data set, its calibration, and a node's config for it."""
    folder = tmp_path_factory.mktemp("live")
    prepared = prepare()
    shutil.copytree(prepared.config.parent, folder, dirs_exist_ok=True)
    config = {
        "robots": [{"name": "apr", "calibration": prepared.calibration.name}],
        "fusion": "ekf",
        "zenoh": {"listen": f"tcp/127.0.0.1:{free_port()}"},
        "replay": {"dataset": prepared.config.name, "speed": "max"},
    }
    (folder / "node.yaml").write_text(yaml.safe_dump(config))
    return folder


def endpoint(config: Path) -> str:
    return str(yaml.safe_load(config.read_text())["zenoh"]["listen"])


def client_of(config: Path) -> zenoh.Session:
    """A client of a node, once it is up."""
    return connected(int(endpoint(config).rpartition(":")[2]))


@pytest.mark.parametrize("loops", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_replay_is_one_command_and_shows_the_batch_odometry(command: InProcess, workplace: Path, loops: int) -> None:
    with load(loops):
        run = command("live", workplace / "node.yaml", "--replay")
    assert run.returncode == 0, run.stderr
    assert "against the simulated truth" in run.stdout
    difference = re.search(r"batch odometry: (\S+) \(m, rad\) at most; 0 messages of odom lost", run.stdout)
    assert difference is not None, run.stdout
    assert float(difference[1]) <= 1e-9
    errors = [float(found) for found in re.findall(r"^o\w+.* {2,}([\d.]+) +[\d.]+ +[\d.]+$", run.stdout, re.MULTILINE)]
    theoretical, calibrated, fused = errors
    assert fused < 0.1 * theoretical
    assert calibrated < theoretical


def test_a_replay_can_name_another_recording_and_may_have_no_samples(command: InProcess, workplace: Path) -> None:
    run = succeeded(command("live", workplace / "node.yaml", "--replay", workplace / "data"))
    assert "against the reference poses of the recording" in run.stdout  # a data set's folder has no truth beside it
    assert "simulated" in run.stdout
    run = succeeded(command("live", workplace / "node.yaml", "--replay", "--seconds", "0"))
    assert "0 wheel samples" in run.stdout
    assert "nan" not in run.stdout


@pytest.mark.slow
def test_a_demonstration_to_which_another_sender_writes_is_one_line_and_no_table(workplace: Path) -> None:
    config = workplace / "node.yaml"
    with Command("live", config, "--replay", "--speed", "20") as demonstration:
        session = client_of(config)
        wheels, came = session.declare_publisher("apr/joint_states"), list[zenoh.Sample]()
        _subscriber = session.declare_subscriber("apr/odom", came.append)
        until(lambda: came and wheels.matching_status.matching, "odometry of the replay")
        stamp = ODOMETRY.decode(came[-1].payload.to_bytes()).stamp
        names = calibration().robot.wheel_names
        until(lambda: len(came) > 3, "more of it")
        for number in range(1, 20):  # a robot whose clock is a day ahead
            ahead = JointState(stamp + 86_400_000_000_000 + number * 10_000_000, names, np.zeros(3))
            wheels.put(JOINT_STATE.encode(ahead))
        out, said = demonstration.ended()
        session.close()
    assert demonstration.process.returncode == 1, out + said
    assert not out
    assert "error: another sender wrote to robot 'apr'" in said


@pytest.mark.slow
def test_ctrl_c_ends_a_replay_with_what_it_has_shown(workplace: Path) -> None:
    config = workplace / "node.yaml"
    with Command("live", config, "--replay", "--speed", "1") as demonstration:
        session, samples = client_of(config), list[zenoh.Sample]()
        _subscriber = session.declare_subscriber("apr/odom", samples.append)
        until(lambda: samples, "odometry of the replay")
        session.close()
        out, said = demonstration.stop(signal.SIGINT)
    assert demonstration.process.returncode == 130
    assert "stopped after" in out
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("\x1b[2Jmine", "apr runs ?[2Jmine now; next, "),
        ("x" * 100_000, "apr': cannot read its node's answer; is it an"),
    ],
)
def test_a_nodes_answer_is_printed_safely(command: InProcess, loopback: Loopback, name: str, words: str) -> None:
    key, answer = "omnibench/apr/swap", json.dumps({"accepted": True, "calibration": name})
    _node = loopback.router.declare_queryable(key, lambda query: query.reply(key, answer))
    run = command("swap", "apr", prepare().calibration, "--connect", loopback.address)
    assert words in run.stderr
    assert len(run.stderr) < 500
    assert run.stderr.replace("\n", "").isprintable()


def test_a_recording_goes_out_and_a_calibration_is_swapped_in(command: InProcess, workplace: Path) -> None:
    """record -> import -> calibrate -> swap, with the real commands."""
    config, mcap = workplace / "node.yaml", workplace / "drive.mcap"
    with Command("live", config) as node:
        session = client_of(config)
        with Command("record", config, "-o", mcap) as recorder:
            until(mcap.exists, "the recorder")
            played = omnibench(
                *("replay", workplace / "data", "--robot", "apr", "--speed", "20", "--connect", endpoint(config)),
                *("--set", "pause=1.5", "--set", "slam={delay: 0.1, jitter: 0, period: 0.25}"),
            )
            assert played.returncode == 0, played.stderr
            _, said = recorder.stop()
        assert recorder.process.returncode == 0, said
        imported = command(
            *("import", "rosbag", mcap, "-o", workplace / "back", "--set", f"robot={workplace / 'calibration.yaml'}")
        )
        assert imported.returncode == 0, imported.stderr
        assert len(load_dataset(workplace / "back").trajectories) == 12
        succeeded(command("calibrate", workplace / "back", "-o", workplace / "again.yaml"))
        again = read_calibration(workplace / "again.yaml")
        np.testing.assert_allclose(
            again.matrix_array, read_calibration(workplace / "calibration.yaml").matrix_array, atol=0.004
        )
        swapped = succeeded(command("swap", "apr", workplace / "again.yaml", "--connect", endpoint(config)))
        assert f"apr runs {again.name} now; next, " in swapped.stderr
        assert "begins with the old calibration" in swapped.stderr  # the config has no state
        assert asked(session, "omnibench/apr/info")["calibration"] == again.name
        for name, file, reason in (
            ("apr", CONFIGS / "live.yaml", "is this a calibration file?"),
            ("apz", workplace / "again.yaml", "did you mean 'apr'?"),
        ):
            assert_refused(command("swap", name, file, "--connect", endpoint(config)), reason)
        session.close()
        assert node.process.poll() is None


def test_a_node_ends_with_a_sentence_that_says_how_to_start_it_again(command: InProcess, workplace: Path) -> None:
    ended = succeeded(command("live", workplace / "node.yaml", "--seconds", "0"))
    assert re.search(r"^node \w+ has ended, .*:\n  omnibench live ", ended.stderr, re.MULTILINE)


def test_a_layout_for_foxglove_is_written_and_replaces_nothing(
    command: InProcess, workplace: Path, tmp_path: Path
) -> None:
    typed = ("live", workplace / "node.yaml", "--seconds", "0", "--layout", tmp_path / "layout.json")
    succeeded(command(*typed))
    assert "3D!apr" in json.loads((tmp_path / "layout.json").read_text())["configById"]
    assert_refused(command(*typed), "layout.json", "is there already")


def test_rerun_is_optional_and_takes_its_own_files(
    command: InProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)  # what an absent package looks like
    refused = command("live", write_node(tmp_path, "apr"), "--rerun")
    assert_refused(refused, 'pip install "omnibench[rerun]"')
    assert refused.returncode == 2
    assert_refused(command("live", write_node(tmp_path, "apr", rerun="drive.mcap")), "rerun", "ends in .rrd")


@pytest.mark.slow
def test_a_robot_of_a_fleet_cannot_write_for_another(command: InProcess, workplace: Path, tmp_path: Path) -> None:
    """The project's own configs, on loopback: certificates, node, rightful robot, intruder."""
    port = free_port()
    succeeded(command("keys", tmp_path / "keys", "node", "apr02", "apr03", "screen", "lab"))
    for name in ("live_fleet.yaml", "live_fleet_client.yaml"):
        text = (CONFIGS / name).read_text().replace("0.0.0.0:7447", f"127.0.0.1:{port}")
        (tmp_path / name).write_text(text.replace("localhost:7447", f"127.0.0.1:{port}").replace("screen.", "apr02."))
    shutil.copy(CONFIGS / "apr02_calibration.yaml", tmp_path)
    client = tmp_path / "live_fleet_client.yaml"
    with Command("live", tmp_path / "live_fleet.yaml"):
        settings = ("--config", client, "--speed", "max")
        assert omnibench("replay", workplace / "data", "--robot", "apr02", *settings).returncode == 0
        written_for_another = omnibench("replay", workplace / "data", "--robot", "apr03", *settings, "--set", "wait=0")
        assert "Traceback" not in written_for_another.stderr
        with Command("listen", "--config", tmp_path / "live_fleet.yaml", "--json") as listener:
            states: dict[str, str] = {}
            while len(states) < 2:
                news = json.loads(listener.process.stdout.readline())
                states |= {news["robot"]: news["health"]["status"]} if news["health"] else {}
    assert states["apr02"] != "waiting"
    assert states["apr03"] == "waiting"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("live", "node.yaml", "data"), ("data", "--replay")),
        (("live", "node.yaml", "--speed", "2"), ("--replay",)),
        (("live", "node.yaml", "--replay"), ("replay.dataset", "--replay DATASET")),
        (("live", "node.yaml", "--replay", "nowhere"), ("nowhere", "no such file")),
        (("live", "node.yaml", "--replay", "small.yaml", "--speed", "quick"), ("--speed", "quick")),
        (("replay", "small.yaml", "--set", "sped=2"), ("unknown key 'sped'", "speed")),
        (("listen", "apr", "--connect", "127.0.0.1:7447"), ("127.0.0.1:7447", "tcp/127.0.0.1:7447")),
        (("listen", "apr", "--connect", "tcp/127.0.0.1:1"), ("tcp/127.0.0.1:1",)),
    ],
)
def test_a_mistake_is_one_line(
    command: InProcess, tmp_path: Path, arguments: tuple[str, ...], parts: tuple[str, ...]
) -> None:
    write_node(tmp_path, "apr")
    write_config(tmp_path, datasets={"flower": {"simulate": flower()}})
    (tmp_path / "data").mkdir()
    refused = command(*arguments)
    assert_refused(refused, *parts)


def test_other_wheels_are_refused_before_anything_is_played(command: InProcess, tmp_path: Path) -> None:
    write_node(tmp_path, "apr")
    write_calibration(calibration(wheels=4), tmp_path / "calibration.yaml")
    write_config(tmp_path, datasets={"flower": {"simulate": flower()}})
    refused = command("live", "node.yaml", "--replay", "small.yaml", "--speed", "max")
    assert_refused(refused, "'synthetic 1'", "fl, fr, rl, rr", "flower", "'apr'", "a, b, c")
    write_node(tmp_path, robots=[{"name": "apr", "calibration": "calibration.yaml", "wheels": {"joints": ["a", "b"]}}])
    assert_refused(command("live", "node.yaml"), "'apr'", "wheels.joints: a, b", "a, b, c")
