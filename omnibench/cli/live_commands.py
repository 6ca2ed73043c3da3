"""The commands of the live runtime: parse, call, print."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from omnibench.cli.options import Plugins, load_given_plugins, plugin_folders
from omnibench.cli.terminal.console import make_console
from omnibench.errors import ConfigError

if TYPE_CHECKING:
    from omnibench.live.config import LiveConfig

live_app = typer.Typer()
_LISTENING = 0.2  # s

ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="YAML with zenoh, profile and domain; or the node's own config.")
]
Connect = Annotated[str | None, typer.Option("--connect", help="Endpoint of a node, as tcp/127.0.0.1:7447.")]
ProfileOption = Annotated[Literal["plain", "rmw", "humble"] | None, typer.Option(help="How topics are keys.")]
Seconds = Annotated[float | None, typer.Option(min=0.0, help="Stop after so long. Default: on Ctrl-C.")]


@live_app.command()
def live(
    config: Annotated[Path, typer.Argument(help="A node in YAML.")],
    dataset: Annotated[
        Path | None,
        typer.Argument(help="With --replay: a data set, or a config with a simulated one. Default: the config's."),
    ] = None,
    replay: Annotated[bool, typer.Option("--replay", help="Play a recording to the node; then judge and end.")] = False,
    speed: Annotated[str | None, typer.Option(help="Of the replay: 1, 10, max. Default: the config's.")] = None,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="Serve Foxglove's WebSocket on loopback.")] = False,
    seconds: Seconds = None,
    plugins: Plugins = None,
) -> None:
    """Run the node: wheel samples in, calibrated odometry out, over Zenoh."""
    from omnibench.live.config import read_live_config

    if replay and config.is_dir() and dataset is not None:  # --replay DATASET before CONFIG
        config, dataset = dataset, config
    chosen = read_live_config(config)
    chosen = chosen.model_copy(update={"plugins": (*chosen.plugins, *plugin_folders(plugins))})
    if foxglove and not chosen.foxglove:
        chosen = chosen.model_copy(update={"foxglove": True})
    if not replay:
        if dataset is not None or speed is not None:
            raise ConfigError(f"{dataset or '--speed'}: is for a replay; say --replay, too")
        return _run(chosen, seconds)
    return _replay_to_node(chosen, dataset, speed, config)


@live_app.command()
def replay(
    dataset: Annotated[Path, typer.Argument(help="A data set, or a config with a simulated one.")],
    robot: Annotated[str, typer.Option(help="As whom it is played.")] = "robot",
    speed: Annotated[str, typer.Option(help="1: as it was; 10: ten times as fast; max.")] = "1",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="As under replay in a node's config.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Whose noise model says how sure the SLAM poses are.")
    ] = None,
    config: ConfigOption = None,
    connect: Connect = None,
    profile: ProfileOption = None,
    plugins: Plugins = None,
) -> None:
    """Play a recording onto Zenoh, as the robot and its SLAM would."""
    from omnibench.cli.terminal.live_tables import print_played
    from omnibench.cli.terminal.progress import ReplayBar, Steps
    from omnibench.config import parse_settings, validate
    from omnibench.live.network.presence import checked_robot
    from omnibench.live.replay.arrivals import ReplayConfig
    from omnibench.live.replay.concatenated_drive import concatenate_recording
    from omnibench.live.replay.played_recording import load_recording
    from omnibench.live.replay.replay_player import Player
    from omnibench.live.stopping import stop_on_signals
    from omnibench.live.wire.topics import GraphNode
    from omnibench.robot.calibration import read_calibration

    checked_robot(robot)
    load_given_plugins(plugins)
    chosen = validate(ReplayConfig, {"speed": _speed(speed), **parse_settings(settings)}, "replay")
    noise = None if calibration is None else read_calibration(calibration).noise
    with Steps(make_console(error=True)) as watch:
        recording = load_recording(dataset, watch=watch)
    drive = concatenate_recording(recording, pause=chosen.pause, split=chosen.split)
    with _client(config, connect, profile, "replay") as (session, keys), stop_on_signals() as stop:
        player = Player(GraphNode(session, keys, "replay"), robot, drive, chosen, noise=noise)
        with ReplayBar(f"{recording.dataset.name} as {robot}") as bar:
            report = player.play(stop, bar)
    print_played(make_console(), report, recording.dataset.simulated)
    if not report.complete:
        raise typer.Exit(130)


@live_app.command()
def listen(
    robot: Annotated[str | None, typer.Argument(help="Default: all that are there.")] = None,
    config: ConfigOption = None,
    connect: Connect = None,
    profile: ProfileOption = None,
    seconds: Seconds = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document a line, once a second.")] = False,
) -> None:
    """Show a robot's odometry live: pose, rate, age, health."""
    from omnibench.cli.terminal.robot_table import listen as show
    from omnibench.live.stopping import stop_on_signals

    with _client(config, connect, profile, "listen") as (session, keys), stop_on_signals() as stop:
        show(robot, session, keys, make_console(), stop, seconds, as_json)


@live_app.command()
def swap(
    robot: Annotated[str, typer.Argument(help="Whose calibration.")],
    calibration: Annotated[Path, typer.Argument(help="The calibration file that is to run.")],
    config: ConfigOption = None,
    connect: Connect = None,
    plugins: Plugins = None,
) -> None:
    """Give a running node another calibration: it runs from the next sample on, and odom does not jump."""
    from omnibench.live.control.swap import swap_calibration

    load_given_plugins(plugins)
    with _client(config, connect, None, "swap") as (session, _):
        swapped = swap_calibration(session, robot, calibration)
    typer.echo(f"{robot}: {swapped.calibration} runs")
    if not swapped.kept:
        typer.echo(f"warning: a node that starts again begins with the old one: {swapped.reason}", err=True)


@live_app.command()
def record(
    robots: Annotated[list[str], typer.Argument(metavar="ROBOT...|CONFIG", help="Whose topics.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The MCAP file to write.")],
    config: ConfigOption = None,
    connect: Connect = None,
    profile: ProfileOption = None,
    seconds: Seconds = None,
    topics: Annotated[list[str] | None, typer.Option("--topic", help="Only this; may be repeated.")] = None,
) -> None:
    """Record live topics into MCAP, which Foxglove and rosbags open."""
    from omnibench.cli.terminal.recording_status import record as write
    from omnibench.live.config import read_live_config
    from omnibench.live.stopping import stop_on_signals
    from omnibench.live.wire.topics import TOPICS

    if len(robots) == 1 and robots[0].endswith((".yaml", ".yml")):
        config = Path(robots[0]) if config is None else config
        robots = [each.name for each in read_live_config(robots[0]).robots]
    with _client(config, connect, profile, "record") as (session, keys), stop_on_signals() as stop:
        write(session, keys, robots, output, make_console(), stop, seconds=seconds, topics=topics or tuple(TOPICS))


@live_app.command()
def keys(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where they go.")],
    names: Annotated[list[str] | None, typer.Argument(help="One certificate each. Default: node, client.")] = None,
    hosts: Annotated[list[str] | None, typer.Option("--host", help="Where the node runs; may be repeated.")] = None,
    days: Annotated[int, typer.Option(min=1, help="How long they are valid.")] = 365,
    users: Annotated[bool, typer.Option("--users", help="Passwords, too, and users.txt for the node.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there, the CA too.")] = False,
) -> None:
    """Make a test CA and certificates for mTLS."""
    from omnibench.live.network.keys import make_keys

    chosen = names or ["node", "client"]
    for file in make_keys(folder, chosen, hosts=hosts or (), days=days, users=users, overwrite=overwrite):
        typer.echo(f"written: {file}")


def _run(config: "LiveConfig", seconds: float | None) -> None:
    from omnibench.cli.terminal.live_tables import node_log
    from omnibench.live.network.access_log import log_refused_access
    from omnibench.live.node import LiveNode
    from omnibench.live.stopping import stop_on_signals, ticks

    with (
        node_log(make_console(error=True)) as log,
        stop_on_signals() as stop,
        log_refused_access(config.zenoh),
        LiveNode(config) as node,
    ):
        for robot in config.robots:
            fused = "fused with SLAM" if config.fusion_of(robot) else "without fusion"
            log.info("%s: %r runs, %s", robot.name, node.trackers[robot.name].calibration.name, fused)
        if not config.robots:
            log.info("no robots in the config: only a router")
        verb = "listens on" if config.zenoh.listening else "is connected to"
        place = ", ".join(config.zenoh.listening or config.zenoh.connecting)
        log.info("node %s %s %s; Ctrl-C ends it", config.name, verb, place)
        for _ in ticks(stop, _LISTENING, seconds):  # a signal that reaches one of Zenoh's threads wakes nobody here
            pass


def _replay_to_node(config: "LiveConfig", dataset: Path | None, speed: str | None, file: Path) -> None:
    from omnibench.cli.terminal.live_tables import node_log, print_demonstration
    from omnibench.cli.terminal.progress import ReplayBar, Steps
    from omnibench.config import validate
    from omnibench.live.network.access_log import log_refused_access
    from omnibench.live.replay.arrivals import ReplayConfig
    from omnibench.live.replay.demonstration import demonstrate
    from omnibench.live.replay.played_recording import load_recording
    from omnibench.live.stopping import stop_on_signals

    source = dataset or config.replay.dataset
    if source is None:
        raise ConfigError(f"{file}: replay.dataset names no recording; say --replay DATASET")
    if speed is not None:
        checked = validate(ReplayConfig, {"speed": _speed(speed)}, "--speed")
        changed = config.replay.model_copy(update={"speed": checked.speed})
        config = config.model_copy(update={"replay": changed})
    with Steps(make_console(error=True)) as watch:
        recording = load_recording(source, watch=watch)
    with (
        ReplayBar(recording.dataset.name) as bar,
        node_log(bar.console, warnings_only=True),
        stop_on_signals() as stop,
        log_refused_access(config.zenoh),
    ):
        shown = demonstrate(config, recording, stop, bar)
    print_demonstration(make_console(), shown)
    if not shown.report.complete:
        raise typer.Exit(130)


@contextmanager
def _client(file: Path | None, connect: str | None, profile: Any, purpose: str) -> Iterator[tuple[Any, Any]]:
    """A client's session, and the keys of the profile."""
    from omnibench.config import validate
    from omnibench.live.config import ClientConfig, read_client_config
    from omnibench.live.network.session import open_session
    from omnibench.live.network.session_config import SessionConfig
    from omnibench.live.wire.topics import KeySpace

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
        session.close()


def _speed(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
