"""The node on Zenoh, with real sessions: what goes in, what comes out, what it answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import ORIGIN, SECOND, calibration, drive, slam
from nodes import as_text, asked, config_of, running, sent
from sessions import until

from omnibench.errors import ConfigError, DataError
from omnibench.live.live_config import LiveConfig, read_live_config
from omnibench.live.messages import DIAGNOSTICS, ODOMETRY, TRANSFORMS, Odometry
from omnibench.live.node import LiveNode


class Heard:
    """Everything that comes on some keys, decoded."""

    def __init__(self, session: zenoh.Session, **kinds: Any) -> None:
        self.messages: dict[str, list[Any]] = {key: [] for key in kinds}
        self._subscribers = [
            session.declare_subscriber(key.replace("__", "/"), self._taker(key, kind)) for key, kind in kinds.items()
        ]

    def _taker(self, key: str, kind: Any) -> Any:
        return lambda sample: self.messages[key].append(kind.decode(sample.payload.to_bytes()))

    def __getitem__(self, key: str) -> list[Any]:
        return self.messages[key]


def test_wheel_samples_become_the_batch_odometry_on_every_topic(tmp_path: Path) -> None:
    path = drive(1.0)
    with running(config_of(tmp_path)) as (_, session):
        heard = Heard(session, apr__odom=ODOMETRY, apr__odometry__filtered=ODOMETRY, tf=TRANSFORMS)
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent(wheels, path.samples())
        until(lambda: len(heard["tf"]) == 101, "the last transform")
        until(lambda: len(heard["apr__odom"]) == 101, "the last odometry")
    odometry: list[Odometry] = heard["apr__odom"]
    assert [each.stamp for each in odometry] == path.stamps
    poses = np.array([each.pose for each in odometry])
    np.testing.assert_allclose(poses[:, :2], path.poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * poses[:, 2]), np.exp(1j * path.poses[:, 2]), atol=1e-9)
    assert len(heard["apr__odometry__filtered"]) == 101


def test_slam_poses_locate_the_robot_in_the_map(tmp_path: Path) -> None:
    path = drive(1.0)
    with running(config_of(tmp_path)) as (node, session):
        heard = Heard(session, apr__odometry__filtered=ODOMETRY)
        wheels, poses = (session.declare_publisher(f"apr/{topic}") for topic in ("joint_states", "slam_pose"))
        until(lambda: wheels.matching_status.matching and poses.matching_status.matching, "subscriptions")
        sent(wheels, path.samples()[:80])
        until(lambda: node.health("apr").counts["samples"] == 80, "the samples")
        poses.put(slam(path.stamps[60], path.poses[60] + [2.0, 0, 0]))
        until(lambda: node.health("apr").counts["poses"] == 1, "the pose")
        sent(wheels, path.samples()[80:])
        until(lambda: len(heard["apr__odometry__filtered"]) == 101, "the last filtered pose")
    last: Odometry = heard["apr__odometry__filtered"][-1]
    np.testing.assert_allclose(last.pose[:2], path.poses[-1, :2] + [2.0, 0], atol=1e-6)
    assert last.frame == "map"


def test_without_fusion_slam_and_tf_are_left_alone(tmp_path: Path) -> None:
    with running(config_of(tmp_path, fusion="none")) as (_, session):
        publisher = session.declare_publisher("apr/slam_pose")
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        assert not publisher.matching_status.matching


def test_diagnostics_come_once_a_second_with_the_counters(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (_, session):
        heard = Heard(session, apr__diagnostics=DIAGNOSTICS)
        session.put("apr/joint_states", b"garbage")
        until(lambda: len(heard["apr__diagnostics"]) >= 3, "three diagnostics")
    first, *_, last = heard["apr__diagnostics"]
    assert 0.8 < (last.stamp - first.stamp) / SECOND / (len(heard["apr__diagnostics"]) - 1) < 1.5
    (status,) = last.statuses
    assert status.name == "omnibench: apr odometry"
    assert status.level == 1
    assert dict(status.values)["undecodable"] == "1"


def test_many_robots_in_one_node_do_not_meet(tmp_path: Path) -> None:
    names = ("apr1", "apr2", "apr3")
    paths = {name: drive(0.5, seed=number) for number, name in enumerate(names)}
    with running(config_of(tmp_path, *names)) as (node, session):
        heard = Heard(session, **{f"{name}__odom": ODOMETRY for name in names})
        for name in names:
            publisher = session.declare_publisher(f"{name}/joint_states")
            until(lambda each=publisher: each.matching_status.matching, "a subscription")
            sent(publisher, paths[name].samples())
        for name in names:
            until(lambda each=name: len(heard[f"{each}__odom"]) == 51, "the last odometry")
            np.testing.assert_allclose(heard[f"{name}__odom"][-1].pose[:2], paths[name].poses[-1, :2], atol=1e-9)
            assert heard[f"{name}__odom"][-1].frame == f"{name}/odom"
        assert set(node.trackers) == set(names)


def test_a_robots_token_comes_and_goes_with_the_node(tmp_path: Path) -> None:
    def alive(session: zenoh.Session) -> list[str]:
        replies = session.liveliness().get("omnibench/*/alive", timeout=2.0)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    router = {"mode": "router", "listen": config_of(tmp_path).zenoh.listening}
    with running(config_of(tmp_path, "apr", zenoh=router)) as (_, session):
        other = {"mode": "client", "connect": list(router["listen"])}
        with LiveNode(config_of(tmp_path, "bob", zenoh=other)):
            until(lambda: alive(session) == ["omnibench/apr/alive", "omnibench/bob/alive"], "both tokens")
        until(lambda: alive(session) == ["omnibench/apr/alive"], "one token")


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A node that has taken a drive of a second."""
    path = drive(1.0)
    with running(config_of(tmp_path_factory.mktemp("driven"))) as (node, session):
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent(wheels, path.samples())
        until(lambda: node.health("apr").counts["samples"] == 101, "the samples")
        yield node, session, path


def test_info_says_what_runs_and_where_its_topics_are(driven: Any) -> None:
    answer = asked(driven[1], "omnibench/apr/info")
    assert answer["calibration"] == "synthetic 1"
    assert answer["topics"]["odom"] == "apr/odom"
    assert answer["wheels"] == ["a", "b", "c"]


def test_health_tells_the_counters(driven: Any) -> None:
    answer = asked(driven[1], "omnibench/apr/health")
    assert answer["counts"]["samples"] == 101
    assert answer["status"] in ("degraded", "stale")


def test_one_question_can_be_for_all_robots(driven: Any) -> None:
    assert asked(driven[1], "omnibench/*/health")["robot"] == "apr"


def test_the_calibration_is_given_as_it_runs(driven: Any) -> None:
    assert asked(driven[1], "omnibench/apr/calibration")["matrix"][0] == list(calibration().matrix[0])


@pytest.mark.parametrize("form", ["{0}.505", "{0}505000000"])
def test_the_pose_at_a_time_is_interpolated(driven: Any, form: str) -> None:
    _, session, path = driven
    answer = asked(session, "omnibench/apr/pose?at=" + form.format(ORIGIN // SECOND))
    assert answer["at_ns"] == ORIGIN + 505_000_000
    assert answer["odom"]["theta"] == pytest.approx(path.poses[50:52, 2].mean(), abs=1e-9)


@pytest.mark.parametrize(
    ("selector", "payload", "message"),
    [
        ("pose?at=yesterday", None, "at: 'yesterday' is not a time"),
        ("pose?at=12", None, "at: 12.000000 s is not within"),
        ("set_pose", '{"x": 1}', "set_pose: key 'y' is missing (and 1 more)"),
        ("set_pose", '{"x": 1, "y": 2, "theta": 3, "z": 4}', "set_pose: unknown key 'z'"),
        ("set_pose", b"\xff\xfe", "the payload is not text"),
        ("calibration", "format: something", "put it there, or ask omnibench/apr/swap"),
        ("swap", "format: something", "format is 'something', expected 'omnibench-calibration/1'"),
        ("swap", "{", "not valid YAML"),
        ("swap", b"\xff\xfe", "not a text in UTF-8"),
    ],
)
def test_a_bad_order_is_refused_with_the_reason(driven: Any, selector: str, payload: Any, message: str) -> None:
    answer = asked(driven[1], f"omnibench/apr/{selector}", payload)
    assert message in answer["error"]


def test_a_pose_can_be_set_and_reset(driven: Any) -> None:
    _, session, _ = driven
    assert asked(session, "omnibench/apr/set_pose", json.dumps({"x": 3, "y": 4, "theta": 1}))["done"] == "set_pose"
    answer = asked(session, "omnibench/apr/pose")
    assert (answer["map"]["x"], answer["map"]["y"], answer["map"]["theta"]) == (3, 4, 1)
    assert asked(session, "omnibench/apr/reset")["done"] == "reset"
    assert not asked(session, "omnibench/apr/health")["fusion"]["located"]


def test_a_wildcard_resets_nobody(driven: Any) -> None:
    _, session, _ = driven
    assert list(session.get("omnibench/*/reset", timeout=1.0)) == []


def test_a_calibration_that_is_put_runs_from_the_next_sample_on_and_odom_does_not_jump(tmp_path: Path) -> None:
    path, other = drive(1.0), calibration(scale=1.2)
    with running(config_of(tmp_path)) as (node, session):
        heard = Heard(session, apr__odom=ODOMETRY)
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent(wheels, path.samples()[:51])
        until(lambda: len(heard["apr__odom"]) == 51, "the first half")
        session.put("omnibench/apr/calibration", as_text(other))
        until(lambda: node.health("apr").counts["swaps"] == 1, "the swap")
        sent(wheels, path.samples()[51:])
        until(lambda: len(heard["apr__odom"]) == 101, "the second half")
    poses = np.array([each.pose for each in heard["apr__odom"]])
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    before = np.linalg.norm(np.diff(path.poses[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(steps[:50], before[:50], atol=1e-9)
    np.testing.assert_allclose(steps[50:], 1.2 * before[50:], rtol=1e-3)


def test_a_bad_calibration_that_is_put_is_refused_and_told_in_health(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (node, session):
        session.put("omnibench/apr/calibration", as_text(calibration(wheels=4)))
        until(lambda: node.health("apr").counts["swaps_refused"] == 1, "the refusal")
        swap = asked(session, "omnibench/apr/health")["last_swap"]
        assert not swap["accepted"]
        assert "has wheels fl, fr, rl, rr; this robot has a, b, c" in swap["reason"]
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1"


@pytest.mark.parametrize("profile", ["rmw", "humble"])
def test_ros_2_finds_topics_under_its_own_keys(tmp_path: Path, profile: str) -> None:
    path = drive(0.1)
    with running(config_of(tmp_path, profile=profile, domain=7)) as (_, session):
        key = asked(session, "omnibench/apr/info")["topics"]["odom"]
        assert key.startswith("7/apr/odom/nav_msgs::msg::dds_::Odometry_/")
        heard: list[zenoh.Sample] = []
        session.declare_subscriber("7/apr/odom/**", heard.append)
        # whatever hash the sender has
        wheels = session.declare_publisher("7/apr/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_other")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent(wheels, path.samples())
        until(lambda: len(heard) == 11, "the odometry")
        attachment = heard[1].attachment
        assert attachment is not None
        content = attachment.to_bytes()
        assert len(content) == 33
        assert int.from_bytes(content[:8], "little") == 2  # counted from 1
        assert content[16] == 16


def test_a_config_is_refused_in_one_line(tmp_path: Path) -> None:
    for changes, message in (
        ({"robots": [{"name": "a b", "calibration": "c.yaml"}]}, r"robots\.0\.name"),
        ({"robots": [{"name": "a", "calibration": "c.yaml"}] * 2}, "names must differ: a, a"),
        ({"fusion": "kalman"}, "fusion"),
        ({"profil": "rmw"}, "unknown key 'profil'; did you mean 'profile'"),
        ({"robots": [], "zenoh": {"mode": "client"}}, "without robots a node can only be a router"),
    ):
        with pytest.raises(ConfigError, match=message):
            config_of(tmp_path, **changes)


def test_a_missing_calibration_is_named(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    (tmp_path / "calibration.yaml").unlink()
    with pytest.raises(DataError, match=r"calibration\.yaml: no such file"):
        LiveNode(config)


def test_the_configs_of_the_project_are_valid() -> None:
    folder = Path(__file__).resolve().parents[2] / "configs"
    for file in (folder / "live.yaml", folder / "live_fleet.yaml"):
        config: LiveConfig = read_live_config(file)
        for robot in config.robots:
            assert robot.calibration.is_file()
