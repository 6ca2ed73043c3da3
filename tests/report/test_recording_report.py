"""The report on a recording: what it tells, where it draws things, and that a browser can play it."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import assert_picture_comes_first, opened
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import COMMANDS, NOISE, PERIOD, TICK, Sample, sample
from report_page import Page
from sample_robots import DIFFERENTIAL
from wheeled_samples import ROBOTS, driven

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.scans import Mount, Scanner, ScansInMemory, TrajectoryScans
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.fit.inspect import inspect_dataset
from omnibench.report.figures import is_placed
from omnibench.report.recording import inspection_report
from omnibench.report.recording.recording_figures import (
    ODOMETRY_ITEM,
    all_runs,
    representative_runs,
    scan_points,
    wheel_rates,
)
from omnibench.report.recording.section import player, recording_document
from omnibench.report.render import write_document
from omnibench.robot.kinematics import Robot, Wheel
from omnibench.robot.model import OdometryModel
from omnibench.slam.slam_dataset import run_errors, slam_accuracy

CONTENTS = "in a room, robot APR-02: simulated data"


@pytest.fixture(scope="module")
def made() -> Sample:
    return sample()


@pytest.fixture(scope="module")
def report(made: Sample, tmp_path_factory: pytest.TempPathFactory) -> Page:
    known = {"truth": made.truth, "plan": made.plan, "starts": made.starts}
    return page(made.dataset, tmp_path_factory.mktemp("recording"), **known)


def page(dataset: Dataset, folder: Path, **options: Any) -> Page:
    """The report on a data set as its reader sees it."""
    write_document(recording_document(dataset, **options), folder / "report.html")
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def played(told: Page) -> dict[str, Any]:
    """What the player reads, by run."""
    found = re.search(r'<script type="application/json" id="[^"]*-runs">(.*?)</script>', told.html, re.DOTALL)
    return json.loads(found[1])


def bare(dataset: Dataset) -> Dataset:
    """The data set without scans, targets, commands and covariances."""
    unknown = {"targets": None, "omega": None, "alpha": None, "v": None, "command": None, "pose_covariances": None}
    runs = tuple(replace(run, **unknown) for run in dataset.trajectories)
    return replace(dataset, trajectories=runs, scans=None)


def test_the_report_answers_first_then_tells_errors_runs_and_what_was_recorded(report: Page) -> None:
    assert report.sections == ["answer", "slam", "player", "wheels", "recorded"]
    assert list(report.tables) == ["Errors of the reference poses against the truth", CONTENTS]
    assert report.text.count("floor plan (truth)") == 1
    assert report.plots == 2 + 2 + 4 + 1  # the last is the player


def test_every_link_of_table_1_has_its_number_and_rate(made: Sample, report: Page) -> None:
    samples = f"{sum(len(run.times) for run in made.dataset.trajectories):,} samples"
    scans = sum(len(run.pose_times) for run in made.dataset.trajectories)
    assert report.row(CONTENTS, "Measured wheel rates")[1:3] == [samples, "10.0 ms"]
    assert report.row(CONTENTS, "Measured wheel rates")[3].startswith("a, b, c; by encoders")
    assert f"{TICK:.3f} rad/s" in report.row(CONTENTS, "Measured wheel rates")[3]
    assert report.row(CONTENTS, "LIDAR scans")[1] == f"{scans} scans"
    median, low, high = map(float, re.findall(r"\d+", report.row(CONTENTS, "LIDAR scans")[2]))
    assert 200 <= low < median < high <= 300


def test_what_was_not_recorded_is_told_so(made: Sample, tmp_path: Path) -> None:
    told = page(bare(made.dataset), tmp_path)
    for name in ("Motion command", "Target wheel rates", "Wheel angles", "LIDAR scans"):
        assert told.row(CONTENTS, name)[1] == "not recorded"
    assert told.row(CONTENTS, "Reference poses")[3] == "without covariances"
    assert told.row(CONTENTS, "Reference poses")[0].endswith("x, y, θ")  # no LIDAR made them
    assert {"wheels", "player"} <= set(told.sections)
    assert all(run["scans"] == [] and run["targets"] is None for run in played(told).values())


def test_commands_are_counted_as_the_robot_was_sent_them(made: Sample, tmp_path: Path) -> None:
    sent = np.array([[0.0, 0.1, 0, 0, 1], [0.5, 0.2, 0, 0, 1]])
    runs = tuple(replace(run, sent=sent) for run in made.dataset.trajectories)
    row = page(replace(made.dataset, trajectories=runs), tmp_path).row(CONTENTS, "Sent commands")
    assert row[1:3] == [f"{2 * len(runs)} commands", "500 ms"]


def test_warnings_are_told(made: Sample, tmp_path: Path) -> None:
    told = page(replace(made.dataset, warnings=("something odd",), simulated=False), tmp_path).text
    assert "something odd" in told
    assert "SIMULATED" not in told


def distance_to_walls(points: np.ndarray, outlines: list[list[list[float]]]) -> np.ndarray:
    """How far points (n, 2) are from the nearest wall."""
    nearest = np.full(len(points), np.inf)
    for outline in outlines:
        for a, b in zip(np.array(outline)[:-1], np.array(outline)[1:], strict=True):
            share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            nearest = np.minimum(nearest, np.hypot(*(points - a - share[:, None] * (b - a)).T))
    return nearest


def test_the_floor_plan_lies_where_the_scans_see_walls(made: Sample, tmp_path: Path) -> None:
    exact = tuple(replace(run, poses=made.truth[run.id].at(run.pose_times)) for run in made.dataset.trajectories)
    told = page(replace(made.dataset, trajectories=exact), tmp_path, plan=made.plan, starts=made.starts)
    for run in played(told).values():
        assert len(run["plan"]) == 2
        points = np.concatenate([np.reshape(scan["points"], (-1, 2)) for scan in run["scans"]])
        # Ranges have a noise of 1 mm, and the robot goes on straight lines between its poses; starts are 5 cm off.
        assert np.quantile(distance_to_walls(points, run["plan"]), 0.99) < 0.005


def test_a_plan_drawn_from_the_mark_is_said_to_be_inexact(made: Sample, tmp_path: Path) -> None:
    told = page(made.dataset, tmp_path, plan=made.plan)
    assert "is drawn from the robot's mark" in told.text


def test_frames_of_the_player_follow_reference_odometry_and_truth(made: Sample, report: Page) -> None:
    runs = played(report)
    assert [name.split(":")[0] for name in runs] == ["straight", "turning left", "turning right", "on the spot"]
    for run, name in zip(runs.values(), COMMANDS, strict=True):
        trajectory = next(t for t in made.dataset.trajectories if t.id.startswith(name) and t.id in str(list(runs)))
        lists = [run[key] for key in ("times", "poses", "odometry", "truth", "rates", "targets")]
        assert {len(each) for each in lists} == {len(run["times"])}
        np.testing.assert_allclose(run["poses"][-1], trajectory.final_pose, atol=1e-3)
        end = made.truth[trajectory.id].at(trajectory.pose_times[-1:])[0]
        np.testing.assert_allclose(run["truth"][-1], end[:2], atol=1e-3)
        assert [scan["t"] for scan in run["scans"]] == [round(t, 4) for t in trajectory.pose_times.tolist()]


def test_rates_of_the_player_are_the_mean_over_the_100_ms_before(made: Sample, report: Page) -> None:
    run = played(report)["straight: (0.2 m/s, 29°, 0.00 rad/s), straight-0"]
    trajectory = next(t for t in made.dataset.trajectories if t.id == "straight-0")
    frame = next(index for index, time in enumerate(run["times"]) if time > 1)
    # Sample k ends at k periods; a frame's time has three digits, so that the mean may be off by a tick's share.
    last = round(run["times"][frame] / PERIOD)
    mean = trajectory.rates[last - 10 : last].mean(axis=0)
    np.testing.assert_allclose(run["rates"][frame], mean, atol=0.11 * TICK)


def test_errors_against_the_truth_are_those_of_the_accuracy(made: Sample, report: Page) -> None:
    accuracy = slam_accuracy(made.dataset, made.truth)
    caption = "Errors of the reference poses against the truth"
    told = {row[0]: row[2] for row in report.tables[caption]}
    assert float(told["position mean (mm)"]) == pytest.approx(1e3 * accuracy.every.position_mean_m, rel=0.05)
    assert float(told["heading mean (°)"]) == pytest.approx(math.degrees(accuracy.every.heading_mean_rad), rel=0.05)
    assert 2 < float(told["nees mean"]) < 4


def test_a_recording_without_truth_has_no_errors(made: Sample, tmp_path: Path) -> None:
    told = page(made.dataset, tmp_path)
    assert "slam" not in told.sections
    assert "true path" not in told.text


@pytest.mark.parametrize("with_accuracy", [False, True])
def test_the_truth_of_other_runs_is_one_line(made: Sample, tmp_path: Path, with_accuracy: bool) -> None:
    accuracy = slam_accuracy(made.dataset, made.truth) if with_accuracy else None
    with pytest.raises(DataError, match="straight-0 is not in the truth"):
        page(made.dataset, tmp_path, truth={"another": made.truth["left-0"]}, accuracy=accuracy)


def test_broken_scans_are_one_line(made: Sample, tmp_path: Path) -> None:
    save_dataset(made.dataset, tmp_path / "data")
    dataset = load_dataset(tmp_path / "data")
    (tmp_path / "data" / "scans.parquet").write_bytes(b"broken")
    with pytest.raises(DataError, match=r"scans\.parquet"):
        page(dataset, tmp_path)


@pytest.mark.slow
def test_long_runs_with_many_scans_stay_below_two_megabytes(tmp_path: Path) -> None:
    long = sample(repetitions=1, duration=30.0, rays=1080)
    many = tuple(replace(run, id=f"{run.id}-{number}") for number in range(100) for run in long.dataset.trajectories)
    scans = long.dataset.scans
    found = ScansInMemory(scans.scanner, {run.id: scans.of(run.id.rsplit("-", 1)[0]) for run in many})
    truth = {run.id: long.truth[run.id.rsplit("-", 1)[0]] for run in many}
    told = page(replace(long.dataset, trajectories=many, scans=found), tmp_path, truth=truth)
    assert len(told.html.encode()) < 2e6


def hostile(run: Trajectory) -> Trajectory:
    return replace(run, id=f"</script><script>alert('{run.id}')</script>")


def test_hostile_names_of_runs_stay_words(made: Sample, tmp_path: Path) -> None:
    scans = made.dataset.scans
    runs = tuple(map(hostile, made.dataset.trajectories))
    again = ScansInMemory(scans.scanner, {hostile(run).id: scans.of(run.id) for run in made.dataset.trajectories})
    told = page(replace(made.dataset, trajectories=runs, scans=again), tmp_path)
    assert "<script>alert" not in told.html
    assert "<script>alert('left-0')</script>" in told.text


DRIVE = """<script>
for (const [name, frame] of [["first", 0], ["last", 1e6]]) {
  const player = document.querySelector(".player"), slider = player.querySelector("input");
  player.querySelector("[name=run]").selectedIndex = 1;
  player.querySelector("[name=run]").dispatchEvent(new Event("change"));
  slider.value = frame;
  slider.dispatchEvent(new Event("input"));
  const ink = player.querySelector("canvas"), copy = new OffscreenCanvas(ink.width, ink.height).getContext("2d");
  copy.drawImage(ink, 0, 0);
  const pixels = new Uint32Array(copy.getImageData(0, 0, ink.width, ink.height).data.buffer);
  document.body.dataset[name] = player.querySelector("output").textContent;
  document.body.dataset[name + "Ink"] = pixels.filter((pixel) => pixel !== 0).length;
}
for (const select of document.querySelectorAll(".choice select")) {
  select.selectedIndex = 2;
  select.dispatchEvent(new Event("change"));
}
</script>"""


@pytest.mark.slow
def test_a_browser_draws_every_plot_and_plays_the_runs(made: Sample, tmp_path: Path) -> None:
    told = page(made.dataset, tmp_path, truth=made.truth, plan=made.plan, starts=made.starts)
    (tmp_path / "driven.html").write_text(told.html.replace("</body>", f"{DRIVE}</body>"), encoding="utf-8")
    drawn, complaints = opened(tmp_path / "driven.html")
    body = dict(re.findall(r'data-([a-z-]+)="([^"]*)"', re.findall(r"<body[^>]*>", drawn)[0]))
    left = next(run for run in representative_runs(made.dataset).values() if run.omega and run.omega > 0)
    x, y, heading = left.final_pose
    assert body["plots"] == "drawn"
    assert body["first"] == "t = 0.00 s: x 0.000 m, y 0.000 m, heading 0.0°"
    assert body["last"].replace("−", "-") == (
        f"t = {left.pose_times[-1]:.2f} s: x {x:.3f} m, y {y:.3f} m, heading {math.degrees(heading):.1f}°"
    )
    assert min(int(body["first-ink"]), int(body["last-ink"])) > 2000
    options = re.findall(r'<div class="option"( hidden="")?>', drawn)
    assert [hidden == "" for hidden in options] == [False, False, True, False]
    assert not complaints


def test_singular_covariances_of_a_foreign_recording_are_left_out_of_the_nees(made: Sample, tmp_path: Path) -> None:
    none = [replace(run, pose_covariances=np.zeros((len(run.poses), 3, 3))) for run in made.dataset.trajectories]
    caption = "Errors of the reference poses against the truth"
    told = page(replace(made.dataset, trajectories=tuple(none)), tmp_path, truth=made.truth)
    assert told.row(caption, "nees mean")[2] == "–"
    some = replace(made.dataset, trajectories=(none[0], *made.dataset.trajectories[1:]))
    assert 2 < float(page(some, tmp_path, truth=made.truth).row(caption, "nees mean")[2]) < 4


@pytest.mark.slow
def test_the_paths_of_a_recording_stand_in_the_first_900_pixels(made: Sample, tmp_path: Path) -> None:
    page(made.dataset, tmp_path, truth=made.truth, plan=made.plan, starts=made.starts)
    assert_picture_comes_first(tmp_path / "report.html")


def test_a_run_with_a_start_pose_alone_is_drawn_all_the_same(made: Sample, tmp_path: Path) -> None:
    short = {"pose_times": np.zeros(1), "pose_covariances": None}
    runs = tuple(replace(run, poses=run.poses[:1], **short) for run in made.dataset.trajectories)
    told = page(replace(made.dataset, trajectories=runs, scans=None), tmp_path)
    assert {len(run["times"]) > 2 for run in played(told).values()} == {True}


# What the figures of a recording show: which runs, where walls are, and how the wheels turned.


def test_of_each_kind_the_run_of_median_odometry_error_is_shown() -> None:
    runs = sample(repetitions=3, duration=1.5).dataset
    wrong = {"left-0": 0.5, "left-1": 0.3, "left-2": -0.4}  # m that the reference is moved by at the end
    moved = [
        replace(run, poses=run.poses + np.outer(run.pose_times == run.pose_times[-1], [wrong.get(run.id, 0), 0, 0]))
        for run in runs.trajectories
    ]
    chosen = representative_runs(replace(runs, trajectories=tuple(moved)))
    assert [run.id for name, run in chosen.items() if name.startswith("turning left")] == ["left-2"]


def test_runs_without_scans_are_not_shown_where_others_have_them(made: Sample) -> None:
    scans = made.dataset.scans
    only = ScansInMemory(scans.scanner, {"left-1": scans.of("left-1")})
    assert [run.id for run in representative_runs(replace(made.dataset, scans=only)).values()] == ["left-1"]


@given(
    x=st.floats(-2, 2),
    y=st.floats(-5, 5),
    heading=st.floats(-0.5, 0.5),
    turn=st.floats(-0.3, 0.3),
    speed=st.floats(-0.5, 0.5),
    mount=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
def test_points_of_a_wall_lie_on_it_however_the_robot_moves(
    x: float, y: float, heading: float, turn: float, speed: float, mount: tuple[float, float, float]
) -> None:
    scanner = Scanner(
        rays=31,
        angle_min=-0.4,
        angle_increment=0.8 / 30,
        time_increment=0.02,
        range_max=1e3,
        mount=Mount(x=mount[0], y=mount[1], yaw=mount[2]),
    )
    begin, velocity = np.array([x, y, heading]), np.array([speed, -speed, turn])
    stamp, wall = 0.2, 10.0
    poses = begin + np.outer(stamp + scanner.delays, velocity)
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    place = poses[:, 0] + cosine * mount[0] - sine * mount[1]
    ranges = (wall - place) / np.cos(poses[:, 2] + mount[2] + scanner.angles)
    reference = np.array([begin, begin + velocity])
    run = replace(sample().dataset.trajectories[0], pose_times=np.array([0.0, 1.0]), poses=reference)
    scans = TrajectoryScans(np.array([stamp]), ranges[None].astype(np.float32))
    points = scan_points(run, scanner, scans, 0)
    assert len(points) == 31
    np.testing.assert_allclose(points[:, 0], wall, atol=1e-4)


def test_rays_that_saw_nothing_make_no_points(made: Sample) -> None:
    scans, run = made.dataset.scans, made.dataset.trajectories[0]
    found = scans.of(run.id)
    ranges = found.ranges.copy()
    ranges[0, ::2] = np.inf
    assert len(scan_points(run, scans.scanner, TrajectoryScans(found.times, ranges), 0)) == 45


def test_the_mean_over_100_ms_is_that_of_the_samples(made: Sample) -> None:
    run = made.dataset.trajectories[0]
    figure = wheel_rates(run, made.dataset.robot).figures[0].plot
    mean = next(trace for trace in figure.data if trace.legendgroup == "mean")
    np.testing.assert_allclose(mean.y[:5], run.rates[:50, 0].reshape(5, 10).mean(axis=1), atol=1e-4)
    np.testing.assert_allclose(mean.x[:5], 0.05 + 0.1 * np.arange(5), atol=1e-9)


def test_the_error_is_measured_minus_target(made: Sample) -> None:
    run = made.dataset.trajectories[0]
    slow = replace(run, rates=np.asarray(run.targets) - 0.25)
    assert wheel_rates(slow, made.dataset.robot).caption == "Measured − target: mean −0.25, RMS 0.25 rad/s."


def test_errors_do_not_depend_on_where_the_reference_has_its_origin(made: Sample) -> None:
    run = made.dataset.trajectories[2]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = run.poses @ turn.T + [3.0, -1.0, math.pi / 2]
    narrow = np.tile(np.diag(NOISE**2 * [1, 9, 1]), (len(run.poses), 1, 1))
    here = run_errors(replace(run, pose_covariances=narrow), made.truth[run.id])
    there = run_errors(replace(run, poses=moved, pose_covariances=turn @ narrow @ turn.T), made.truth[run.id])
    np.testing.assert_allclose(there.position, here.position, atol=1e-12)
    np.testing.assert_allclose(there.nees, here.nees, rtol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_measured_rates_and_steering_angles_have_a_row_each(robot: Robot) -> None:
    run = driven(robot, runs=1, samples=20).trajectories[0]
    plots = [figure.plot for figure in wheel_rates(run, robot).figures]
    titles = [axis.title.text for plot in plots for axis in plot.select_yaxes()]
    assert titles == [f"{name} (rad/s)" for name in robot.wheel_names] + [f"{name} (°)" for name in robot.drive.steered]
    steering = [trace.y for plot in plots for trace in plot.data if trace.legendgroup == "steering"]
    if run.steering is not None:
        np.testing.assert_allclose(steering, np.degrees(run.steering.T), atol=0.01)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_the_player_draws_every_wheel_where_it_stands_and_turns_those_that_steer(robot: Robot) -> None:
    dataset = driven(robot, runs=1, samples=20)
    run = dataset.trajectories[0]
    played = player(dataset, {"run": run}, OdometryModel.of_design(robot, "arc"), {}, {}).runs["run"]
    assert played["rated"] == robot.wheel_names
    assert [tuple(wheel["at"]) for wheel in played["wheels"]] == [wheel.position for wheel in robot.wheels]
    turned = [wheel["steered"] for wheel in played["wheels"] if wheel["steered"] is not None]
    assert turned == list(range(len(robot.drive.steered)))
    assert (played["steering"] is None) == (run.steering is None)
    assert run.steering is None or len(played["steering"]) == len(played["times"])


def test_a_mecanum_wheel_given_by_its_lever_arm_only_is_not_drawn(made: Sample) -> None:
    rollers = {"roller_angle_deg": 45}
    placed = Wheel.model_validate({"name": "a", "radius": 0.05, "x": 0.1, "y": 0.1} | rollers)
    lever = Wheel.model_validate({"name": "a", "radius": 0.05, "distance": 0.2, "angle_deg": 90} | rollers)
    assert [is_placed(wheel) for wheel in (placed, lever, *made.dataset.robot.wheels)] == [True, False, *[True] * 3]


def test_without_reference_poses_the_overview_shows_the_odometry(made: Sample) -> None:
    runs = tuple(
        replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1], pose_covariances=None)
        for run in made.dataset.trajectories
    )
    drawn = all_runs(replace(made.dataset, trajectories=runs, scans=None), runs[0], ())
    assert drawn.legend[0] == ODOMETRY_ITEM
    assert np.ptp([x for x in drawn.figures[0].plot.data[0].x if x is not None]) > 0.5


# The report of an inspection: motions that were driven, what can be identified, and that the answer comes first.


def driving(robot: Robot, *twists: tuple[float, float, float]) -> list[Trajectory]:
    """Runs of four seconds, each at one twist by the design values."""
    times = np.arange(1, 81) * 0.05
    return [
        Trajectory(
            id=f"run-{number}",
            split="train",
            times=times,
            rates=np.tile(np.array(twist) @ robot.signal_equations.T, (len(times), 1)),
            pose_times=np.zeros(1),
            poses=np.zeros((1, 3)),
        )
        for number, twist in enumerate(twists)
    ]


OMNI = sample().dataset.robot


@pytest.mark.parametrize(
    ("twist", "kinds"),
    [
        ((0.2, 0.0, 0.0), {"straight", "forward"}),
        ((-0.2, 0.0, 0.0), {"straight", "backward"}),
        ((0.1, 0.0, 0.02), {"straight", "forward"}),  # what a straight line of uneven wheels turns by
        ((0.2, 0.0, 0.5), {"curves to the left", "forward"}),
        ((0.0, 0.2, -0.5), {"curves to the right", "sideways to the left"}),
        ((0.0, -0.2, 0.0), {"straight", "sideways to the right"}),
        ((0.0, 0.0, 0.5), {"on the spot to the left"}),
        ((0.0, 0.0, -0.5), {"on the spot to the right"}),
    ],
)
def test_a_motion_is_known_by_its_direction_and_turn(twist: tuple[float, float, float], kinds: set[str]) -> None:
    shares = shares_of_motions(driving(OMNI, twist), OMNI)
    assert {name for name, share in shares.items() if share != "not driven"} == kinds
    assert set(shares.values()) <= {"100 %", "not driven"}


def shares_of_motions(runs: list[Trajectory], robot: Robot) -> dict[str, str]:
    """The share of the time of each kind of motion, as the table tells it."""
    return {row.cells[0].text: row.cells[1].text for row in inspection_report.motion_table(runs, robot).rows}


def test_time_at_rest_is_no_motion() -> None:
    shares = shares_of_motions(driving(OMNI, (0.2, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)), OMNI)
    assert shares["straight"] == "50 %" == shares["on the spot to the left"]
    on_two_wheels = shares_of_motions(driving(DIFFERENTIAL, (0.2, 0.0, 0.0)), DIFFERENTIAL)
    assert not [name for name in on_two_wheels if name.startswith("sideways")]


def inspected(dataset: Dataset, folder: Path) -> Path:
    """The file of the report of an inspection."""
    write_document(
        inspection_report.InspectionResult(inspect_dataset(dataset), dataset).document(), folder / "report.html"
    )
    return folder / "report.html"


@pytest.fixture(scope="module")
def inspection_file(made: Sample, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return inspected(made.dataset, tmp_path_factory.mktemp("inspection"))


@pytest.fixture(scope="module")
def inspection(inspection_file: Path) -> Page:
    return Page(inspection_file.read_text(encoding="utf-8"))


def test_the_report_of_an_inspection_answers_first_and_tells_what_was_driven(inspection: Page) -> None:
    assert inspection.sections == ["answer", "motions", "identified", "player", "wheels", "recorded"]
    assert "Not driven to train: on the spot to the right, backward, sideways to the left" in inspection.text
    assert {"Motions driven", CONTENTS} <= set(inspection.tables)


def test_every_parameter_has_its_precision(made: Sample, inspection: Page) -> None:
    found = inspect_dataset(made.dataset).identifiability.parameters
    rows = inspection.tables["Wheels, as these runs determine them"][1:]
    assert [row[3] == "determined" for row in rows] == [parameter.told for parameter in found]
    assert {row[1][-1] for row in rows} == {"m", "°"}


@pytest.mark.slow
def test_the_paths_stand_in_the_first_900_pixels(inspection_file: Path) -> None:
    assert_picture_comes_first(inspection_file)


def test_runs_that_are_all_alike_leave_motions_open(made: Sample, tmp_path: Path) -> None:
    only = [replace(run, split="train") for run in made.dataset.trajectories if run.command == "straight"]
    few = replace(made.dataset, trajectories=tuple(only), scans=None)
    told = Page(inspected(few, tmp_path).read_text(encoding="utf-8"))
    assert "Not driven to train: curves to the left" in told.text
    assert "Part of the matrix stays open" in told.text
