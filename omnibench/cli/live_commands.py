"""The commands of the live runtime: the node, and the programs that work with a running one."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from omnibench.cli import options as shared
from omnibench.cli.options import argument, flag, option, output_option
from omnibench.cli.terminal.console import make_console, print_ending, print_next, warn
from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.errors import ConfigError
from omnibench.files import refuse_existing, remove, write_text

if TYPE_CHECKING:
    from omnibench.live.config import LiveConfig

live_app = typer.Typer()
_LISTENING = 0.2  # s between two looks at whether a signal came; chosen

Profile = Literal["plain", "rmw", "humble"]
_CONFIG = option("How to reach the node: YAML with zenoh, profile, domain; or the node's own config.", "--config")
_CONNECT = option("Endpoint of the node, for example tcp/127.0.0.1:7447.", "--connect")
_PROFILE = option(
    "Naming of topics: plain Zenoh, rmw_zenoh, or that of ROS 2 Humble. Default: as in --config, or plain."
)
_SECONDS = option("Stop after this time, in s. Default: on Ctrl-C.", min=0.0)


@live_app.command()
def live(
    config: Path = argument("Config of the node (YAML).", ...),
    dataset: Path | None = argument(
        "With --replay: data set folder, or config with a simulated one. Default: the config's."
    ),
    replay: bool = flag("Play a recording to the node, show its errors, and end.", "--replay"),
    speed: str | None = option("Speed of the replay: 1, 10, ... or max. Default: the config's."),
    foxglove: bool = flag("Serve Foxglove's WebSocket on this computer.", "--foxglove"),
    layout: Path | None = option("Write a layout for Foxglove, to import there.", metavar="FILE.json"),
    rerun: bool = flag("Show the robots in Rerun; the config can name a file for it.", "--rerun"),
    seconds: float | None = _SECONDS,
    plugins: list[Path] | None = shared.PLUGINS,
) -> None:
    """Run the node: wheel samples in, odometry out, over Zenoh.

    With --replay it needs no robot: a recording is played to the node.
    """
    from omnibench.live.config import read_live_config

    if replay and config.is_dir() and dataset is not None:  # --replay DATASET before CONFIG
        config, dataset = dataset, config
    chosen = read_live_config(config)
    chosen = chosen.model_copy(update={"plugins": (*chosen.plugins, *shared.plugin_folders(plugins))})
    asked = {"foxglove": foxglove and not chosen.foxglove, "rerun": rerun and not chosen.rerun}
    chosen = chosen.model_copy(update={key: True for key, is_asked in asked.items() if is_asked})
    if layout is not None:
        from omnibench.live.viewers import foxglove_layout

        refuse_existing(layout, force=False)
        write_text(layout, foxglove_layout(chosen))
    if not replay:
        if dataset is not None or speed is not None:
            raise ConfigError(f"{dataset or '--speed'}: is for a replay only; add --replay")
        return _run_node(chosen, config, seconds)
    return _replay_to_node(chosen, dataset, speed, config, seconds)


def _run_node(config: "LiveConfig", file: Path, seconds: float | None) -> None:
    """Run the node until a signal comes, or for ``seconds``."""
    from omnibench.cli.terminal.live_tables import node_log
    from omnibench.live.node import LiveNode
    from omnibench.live.stopping import stop_on_signals, ticks

    with node_log(make_console(error=True)) as log, stop_on_signals() as stop, LiveNode(config, stop=stop) as node:
        for robot in config.robots:
            fused = "fused with SLAM" if config.fusion_of(robot) else "without fusion"
            log.info("%s: %r runs, %s", robot.name, node.trackers[robot.name].calibration.name, fused)
        if not config.robots:
            log.info("no robots in the config: only a router")
        verb = "listens on" if config.zenoh.listening else "is connected to"
        place = ", ".join(config.zenoh.listening or config.zenoh.connecting)
        log.info("node %s %s %s; Ctrl-C ends it", config.name, verb, place)
        for _ in ticks(stop, _LISTENING, seconds):  # a signal that reaches a thread of Zenoh's wakes nobody here
            pass
    print_ending(f"node {config.name} has ended, and sends nothing more", "start it again", "omnibench", "live", file)


def _replay_to_node(
    config: "LiveConfig", dataset: Path | None, speed: str | None, file: Path, seconds: float | None
) -> None:
    """Play a recording to a node of this process, and show the errors of its odometry."""
    from omnibench.cli.terminal.live_tables import DemonstrationResult, node_log
    from omnibench.config import validate
    from omnibench.live.demonstration import demonstrate
    from omnibench.live.drive import ReplayConfig, load_recording
    from omnibench.live.stopping import stop_on_signals
    from omnibench.report.terminal import print_result

    source = dataset or config.replay.dataset
    if source is None:
        raise ConfigError(f"{file}: replay.dataset names no recording; say --replay DATASET")
    if speed is not None:
        checked = validate(ReplayConfig, {"speed": speed}, "--speed")
        config = config.model_copy(update={"replay": config.replay.model_copy(update={"speed": checked.speed})})
    with ProgressDisplay() as watch:
        recording = load_recording(source, watch=watch)
    with ProgressDisplay() as watch, node_log(watch.console, warnings_only=True), stop_on_signals() as stop:
        demonstration = demonstrate(config, recording, stop, watch, math.inf if seconds is None else seconds)
    result = DemonstrationResult(demonstration, file)
    print_result(make_console(), result)
    if demonstration.report.interrupted:
        raise typer.Exit(130)
    print_next(result)


@live_app.command()
def replay(
    dataset: Path = argument("Data set folder, or config with a simulated one.", ...),
    robot: str = option("Name of the robot that is played.", default="robot"),
    speed: str = option("1: as recorded; 10: ten times as fast; max: as fast as can be.", default="1"),
    settings: list[str] | None = option(
        "Set what a node's config holds under replay; may be repeated.", "--set", metavar="KEY=VALUE"
    ),
    calibration: Path | None = option("Calibration whose noise model gives the covariance of the SLAM poses."),
    config: Path | None = _CONFIG,
    connect: str | None = _CONNECT,
    profile: Profile | None = _PROFILE,
    seconds: float | None = _SECONDS,
    plugins: list[Path] | None = shared.PLUGINS,
) -> None:
    """Play a recording onto Zenoh, as the robot and its SLAM would.

    An omnibench node acknowledges what it takes, and is waited for; other programs do not, which is said.
    """
    from omnibench.cli.terminal.live_tables import PlayedResult
    from omnibench.config import parse_settings, validate
    from omnibench.live.drive import ReplayConfig, concatenate_recording, load_recording
    from omnibench.live.presence import checked_robot
    from omnibench.live.replay import Player
    from omnibench.live.stopping import stop_on_signals
    from omnibench.live.topics import GraphNode
    from omnibench.report.terminal import print_result
    from omnibench.robot.calibration import read_calibration

    checked_robot(robot)
    shared.load_given_plugins(plugins)
    chosen = validate(ReplayConfig, {"speed": speed, **parse_settings(settings)}, "replay")
    noise = None if calibration is None else read_calibration(calibration).noise
    with ProgressDisplay() as watch:
        recording = load_recording(dataset, watch=watch)
    drive = concatenate_recording(recording, pause=chosen.pause, split=chosen.split)
    with _client(config, connect, profile, "replay") as (session, keys), stop_on_signals() as stop:
        player = Player(GraphNode(session, keys, "replay"), robot, drive, chosen, noise=noise)
        with ProgressDisplay() as watch:
            report = player.play(stop, watch, seconds=math.inf if seconds is None else seconds)
    result = PlayedResult(report, recording.dataset.simulated, robot)
    print_result(make_console(), result)
    if report.interrupted:
        raise typer.Exit(130)
    print_next(result)


@live_app.command()
def listen(
    robot: str | None = argument("Name of the robot. Default: all that are heard."),
    config: Path | None = _CONFIG,
    connect: str | None = _CONNECT,
    profile: Profile | None = _PROFILE,
    seconds: float | None = _SECONDS,
    as_json: bool = flag("Print one JSON document a line, once a second.", "--json"),
) -> None:
    """Show a robot's odometry live: pose, rate, age, health."""
    from omnibench.cli.terminal.live_tables import listen as show
    from omnibench.live.stopping import stop_on_signals

    with _client(config, connect, profile, "listen") as (session, keys), stop_on_signals() as stop:
        show(robot, session, keys, make_console(), stop, seconds, as_json)
    if not as_json:
        print_ending(
            "listening has ended", "keep what is sent", "omnibench", "record", robot or "ROBOT", "-o", "drive.mcap"
        )


@live_app.command()
def swap(
    robot: str = argument("Name of the robot.", ...),
    calibration: Path = argument("Calibration file to run from now on.", ...),
    config: Path | None = _CONFIG,
    connect: str | None = _CONNECT,
    plugins: list[Path] | None = shared.PLUGINS,
) -> None:
    """Give a running node another calibration, without a jump.

    It holds from the next wheel sample on; the odometry goes on from where it is.
    """
    from omnibench.live.control import swap_calibration

    shared.load_given_plugins(plugins)
    with _client(config, connect, None, "swap") as (session, _):
        swapped = swap_calibration(session, robot, calibration)
    if not swapped.kept:
        warn([f"after a restart the node begins with the old calibration: {swapped.reason}"])
    print_ending(f"{robot} runs {swapped.calibration} now", "watch its odometry", "omnibench", "listen", robot)


@live_app.command()
def record(
    robots: list[str] = argument("Names of robots, or the config of a node with them.", ..., metavar="ROBOT...|CONFIG"),
    output: Path = output_option("MCAP file to write.", default=..., metavar="FILE.mcap"),
    config: Path | None = _CONFIG,
    connect: str | None = _CONNECT,
    profile: Profile | None = _PROFILE,
    seconds: float | None = _SECONDS,
    topics: list[str] | None = option("Record only this topic; may be repeated. Default: all.", "--topic"),
    force: bool = shared.FORCE,
) -> None:
    """Record live topics into MCAP, for Foxglove and rosbags."""
    from omnibench.cli.terminal.live_tables import record as write
    from omnibench.live.config import read_live_config
    from omnibench.live.stopping import stop_on_signals
    from omnibench.live.topics import TOPICS

    refuse_existing(output, force=force)
    if len(robots) == 1 and robots[0].endswith((".yaml", ".yml")):
        config = Path(robots[0]) if config is None else config
        robots = [each.name for each in read_live_config(robots[0]).robots]
    with _client(config, connect, profile, "record") as (session, keys), stop_on_signals() as stop:
        if force and output.is_file():
            remove(output)
        write(session, keys, robots, output, make_console(), stop, seconds=seconds, topics=topics or tuple(TOPICS))
    print_ending(f"{output} is complete", "open it in Foxglove, or make a data set of it (omnibench guide data)")


@live_app.command()
def keys(
    folder: Path = argument("Folder to write to.", ..., metavar="DIR"),
    names: list[str] | None = argument("Who gets a certificate. Default: node and client."),
    router: str | None = option(
        "Who of these runs the node that the others connect to. Default: node.", metavar="NAME"
    ),
    hosts: list[str] | None = option(
        "Name or address of the computer that this node runs on; may be repeated.", "--host"
    ),
    days: int = option("Validity, in days.", default=365, min=1),
    users: bool = flag("Also make passwords, and a users.txt for the node.", "--users"),
    force: bool = flag("Replace files that exist, the authority (CA) too.", "--force", "--overwrite"),
) -> None:
    """Make a test authority (CA) and certificates for mutual TLS."""
    from omnibench.live.keys import make_keys

    chosen = names or ["node", "client"]
    made = make_keys(folder, chosen, router=router, hosts=hosts or (), days=days, users=users, overwrite=force)
    for file in made:
        typer.echo(f"written: {file}")
    print_ending(f"{folder} holds keys for {', '.join(chosen)}", "read how to use them", "omnibench", "guide", "live")


@contextmanager
def _client(file: Path | None, connect: str | None, profile: Any, purpose: str) -> Iterator[tuple[Any, Any]]:
    """A client's session, and the keys of the profile."""
    from omnibench.config import validate
    from omnibench.live.config import ClientConfig, read_client_config
    from omnibench.live.network import SessionConfig, close_session, open_session
    from omnibench.live.topics import KeySpace

    chosen: ClientConfig = ClientConfig() if file is None else read_client_config(file)
    if connect is not None:
        checked = validate(SessionConfig, {"mode": "client", "tls": chosen.zenoh.tls, "connect": connect}, "--connect")
        chosen = chosen.model_copy(
            update={"zenoh": chosen.zenoh.model_copy(update={"connect": checked.connect, "mode": "client"})}
        )
    session = open_session(chosen.zenoh, purpose)
    try:
        yield session, KeySpace(profile or chosen.profile, chosen.domain)
    finally:
        close_session(session)
