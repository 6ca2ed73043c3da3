"""``import``, ``inspect``, ``design``, ``simulate`` and ``slam``: recordings, and what to record."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from omnibench.cli.options import (
    BackendName,
    DatasetFolders,
    Figures,
    Force,
    Json,
    Plugins,
    Settings,
    TableFormat,
    TlsAuthority,
    TlsCertificate,
    TlsKey,
    WhichDataset,
    Workers,
    asked_backend,
    load_given_plugins,
    output_option,
    refuse_figures_without_browser,
    tls_files,
    write_asked_figures,
)
from omnibench.cli.terminal.console import make_console, print_ending, print_json, warn
from omnibench.errors import ConfigError
from omnibench.words import plural

recording_app = typer.Typer()


@recording_app.command()
def inspect(
    dataset: DatasetFolders,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Write a page: paths, motions driven, wheel rates, runs step by step."),
    ] = None,
    figures: Figures = None,
    backend: BackendName = None,
    workers: Workers = None,
    tls_ca: TlsAuthority = None,
    tls_cert: TlsCertificate = None,
    tls_key: TlsKey = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Show what a data set holds, and what can be identified from it."""
    from omnibench.cli.terminal.inspection_summary import print_inspection
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.data.storage import load_dataset
    from omnibench.files import refuse_existing
    from omnibench.fit.inspect import inspect_dataset
    from omnibench.report.recording.inspection_report import inspection_document
    from omnibench.report.render import write_document

    refuse_existing(report, force=force)
    refuse_figures_without_browser(figures)
    tls = tls_files(tls_ca, tls_cert, tls_key)
    with ProgressDisplay() as watch, asked_backend(backend, workers, tls, (), watch):
        recordings = load_dataset(dataset)
        inspection = inspect_dataset(recordings)
    if report is not None or figures is not None:
        document = inspection_document(recordings, inspection)
        if report is not None:
            write_document(document, report)
            typer.echo(f"report: {report}", err=True)
        write_asked_figures(document, figures)
    if as_json:
        return print_json(inspection)
    print_inspection(make_console(), inspection)
    warn(inspection.warnings)
    named = dataset[0] if len(dataset) == 1 else recordings.name
    missing = [each.motion for each in inspection.identifiability.directions if each.state != "driven" and each.motion]
    if missing:
        return print_ending(
            f"{named} hardly tells {' or '.join(missing)}", "read what to drive", "omnibench", "guide", "driving"
        )
    told = f"{named} determines {'all' if not inspection.identifiability.sentences else 'most'} of the matrix"
    return print_ending(told, "calibrate it", "omnibench", "calibrate", *dataset, "-o", "calibration.yaml")


@recording_app.command()
def design(
    source: Annotated[
        Path | None,
        typer.Argument(metavar="DATASET|CONFIG", help="Data set folder, or config of a comparison or a design."),
    ] = None,
    use: Annotated[
        Literal["trajectory", "final"],
        typer.Option(help="Reference poses to calibrate from: all of a run's, or only its final one."),
    ] = "trajectory",
    per: Annotated[
        Literal["run", "second", "metre"], typer.Option(help="Effort to keep small: runs, time or distance.")
    ] = "run",
    runs: Annotated[
        int | None, typer.Option(min=1, help="Runs to choose. Default: the fewest within 1 % of the optimum.")
    ] = None,
    repetitions: Annotated[int | None, typer.Option(min=1, help="How often a command may be chosen at most.")] = None,
    dataset: WhichDataset = None,
    integration: Annotated[
        Literal["euler", "arc"] | None,
        typer.Option(help="Path within a sample; see calibrate. Default: the config's, or arc for a data set."),
    ] = None,
    robot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Instead of DATASET|CONFIG: a robot alone (robot: as in dataset.yaml)."),
    ] = None,
    max_speed: Annotated[
        float | None, typer.Option(help="With --robot: its greatest speed, m/s. Default: 0.5.")
    ] = None,
    max_turn_rate: Annotated[
        float | None, typer.Option(help="With --robot: its fastest turn, rad/s. Default: 1.")
    ] = None,
    max_wheel_rate: Annotated[
        float | None,
        typer.Option(help="With --robot: of any wheel, rad/s. Default: as straight on at the greatest speed."),
    ] = None,
    steering_limit: Annotated[
        float | None,
        typer.Option(help="With --robot: largest steering angle, deg. Default: tricycle 80, car 35, others 90."),
    ] = None,
    area: Annotated[
        str | None, typer.Option(metavar="AxB", help="With --robot: free floor, m, like 3x2.5. Default: 3x3.")
    ] = None,
    position_noise: Annotated[
        float | None, typer.Option(help="With --robot: of the reference's positions, m. Default: 0.005.")
    ] = None,
    heading_noise: Annotated[
        float | None, typer.Option(help="With --robot: of the reference's headings, deg. Default: 0.3.")
    ] = None,
    output: Annotated[
        Path | None, output_option("Folder for report.html and design.json. Default: nothing is written.")
    ] = None,
    figures: Figures = None,
    force: Force = False,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Choose the motion commands that are most worth driving.

    These are the runs from which the matrix would be calibrated most precisely (D-optimal design): of those that were
    recorded or that a config lists, or, with --robot, of lines, arcs and turns that fit robot and room.
    """
    from omnibench.cli.terminal.design_summary import print_design
    from omnibench.config import to_json
    from omnibench.design.candidates import RobotOptions, design_source
    from omnibench.design.design import design_experiment
    from omnibench.design.report import design_document
    from omnibench.files import refuse_existing, write_text
    from omnibench.report.render import write_document

    refuse_figures_without_browser(figures)
    if output is not None:
        refuse_existing(output / "design.json", output / "report.html", force=force)
    load_given_plugins(plugins)
    limits = RobotOptions(max_speed, max_turn_rate, max_wheel_rate, steering_limit, area, position_noise, heading_noise)
    chosen = design_experiment(
        design_source(source, robot, limits, dataset=dataset, integration=integration),
        use=use,
        per=per,
        runs=runs,
        repetitions=repetitions,
        dataset=dataset,
        integration=integration,
    )
    if output is not None:
        write_text(output / "design.json", to_json(chosen) + "\n")
        write_document(design_document(chosen), output / "report.html")
    write_asked_figures(design_document(chosen), figures)
    if as_json:
        return print_json(chosen)
    print_design(make_console(), chosen)
    if output is not None:
        typer.echo(f"report: {output / 'report.html'}")
    what = plural(chosen.sets[0].step.effort.runs, "run")
    drive = "drive them and make a data set of the recordings (omnibench guide data)"
    return print_ending(f"{what} tell the most of {chosen.robot}", drive)


@recording_app.command()
def slam(
    dataset: Annotated[Path, typer.Argument(help="Data set folder with laser scans.")],
    output: Annotated[Path | None, output_option("Data set folder to write, with the new poses.")] = None,
    start: Annotated[
        Literal["odometry", "last_pose"] | None,
        typer.Option(help="First guess of each scan's pose. Default: odometry."),
    ] = None,
    no_deskew: Annotated[
        bool, typer.Option("--no-deskew", help="Leave out the correction for the robot's motion during a scan.")
    ] = False,
    model: Annotated[
        Path | None,
        typer.Option(metavar="CALIBRATION", help="Calibration for that odometry. Default: the design values."),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder that simulate --truth wrote: show the errors against it."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with figures of scans, paths and wheels.")
    ] = None,
    figures: Figures = None,
    settings: Settings = None,
    table_format: TableFormat = "parquet",
    force: Force = False,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Compute reference poses from the laser scans of a data set.

    Each scan is matched against a map that grows from scan to scan.
    """
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.cli.terminal.slam_summary import print_slam
    from omnibench.config import parse_settings, validate
    from omnibench.files import refuse_existing
    from omnibench.progress import Progress
    from omnibench.report.recording.section import recording_document
    from omnibench.report.render import write_document
    from omnibench.slam.slam_options import SlamOptions
    from omnibench.slam.slam_request import SlamRequest

    load_given_plugins(plugins)
    given: dict[str, Any] = {} if start is None else {"start": start}
    given |= {"deskew": False} if no_deskew else {}
    request = SlamRequest(
        dataset, output, validate(SlamOptions, parse_settings(settings) | given, "slam --set"), model, truth, force
    )
    refuse_existing(report, force=force)
    refuse_figures_without_browser(figures)
    if output is None and report is None and figures is None and not as_json:
        raise ConfigError("say where the poses go: -o DATASET; or ask for figures alone: --json, --report FILE.html")
    with ProgressDisplay() as watch:
        result = request.run(watch, table_format)
        if report is not None or figures is not None:
            watch(Progress("writing the report"))
            document = recording_document(result.dataset, truth=result.truth, accuracy=result.summary.accuracy)
            if report is not None:
                write_document(document, report)
            write_asked_figures(document, figures)
    warn(result.summary.warnings)
    if as_json:
        return print_json(result.summary)
    print_slam(make_console(), result.summary)
    for what, file in (("report", report), (plural(result.summary.runs, "trajectory"), output)):
        if file is not None:
            typer.echo(f"{what}: {file}")
    poses = f"{plural(result.summary.scans, 'scan')} gave poses"
    if output is None:
        return print_ending(f"{poses}, which are written nowhere", "write a data set with them with -o DATASET")
    return print_ending(poses, "calibrate with them", "omnibench", "calibrate", output, "-o", "calibration.yaml")


@recording_app.command()
def simulate(
    output: Annotated[Path, output_option("Data set folder to write.")],
    config: Annotated[Path | None, typer.Argument(help="Config with a simulated data set.")] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the truth: matrix, effects, true poses. Default: not written."),
    ] = None,
    dataset: WhichDataset = None,
    effects: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="YAML", help="Add an effect, 'name: {parameter: value}'; may be repeated."),
    ] = None,
    like: Annotated[
        Path | None,
        typer.Option(metavar="DATASET", help="Instead of CONFIG: drive this data set's recorded wheel rates."),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="CALIBRATION", help="With --like: the true model, a calibration file.")
    ] = None,
    noise: Annotated[
        bool, typer.Option("--noise", help="With --like: add the noise that the calibration states.")
    ] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="With --noise: its seed. Default: 0.")] = None,
    table_format: TableFormat = "parquet",
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with figures of the recording and the truth.")
    ] = None,
    figures: Figures = None,
    force: Force = False,
    plugins: Plugins = None,
) -> None:
    """Simulate recordings of a robot whose true model is known.

    The truth stays out of the data set: it is written to another folder with --truth, or else nowhere.
    """
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.cli.terminal.slam_summary import print_slam_accuracy
    from omnibench.files import refuse_existing
    from omnibench.progress import Progress
    from omnibench.report.recording.section import recording_document
    from omnibench.report.render import write_document
    from omnibench.simulate.simulation_request import SimulationRequest

    hidden = tuple(effects or ())
    request = SimulationRequest(output, config, truth, dataset, hidden, like, model, noise, seed, force)
    refuse_existing(report, force=force)
    refuse_figures_without_browser(figures)
    load_given_plugins([*(plugins or []), *request.plugins] or None)
    with ProgressDisplay() as watch:
        made = request.write(table_format, watch)
        if report is not None or figures is not None:
            watch(Progress("writing the report"))
            shown = made.simulation
            known: dict[str, Any] = {"truth": shown.paths, "plan": shown.plan, "starts": shown.starts} if shown else {}
            document = recording_document(made.dataset, accuracy=made.accuracy, **known)
            if report is not None:
                write_document(document, report)
            write_asked_figures(document, figures)
    warn(made.dataset.warnings)
    if made.accuracy is not None:
        print_slam_accuracy(make_console(), made.accuracy)
    if truth is not None:
        typer.echo(f"truth: {truth / 'truth.yaml'}")
    if report is not None:
        typer.echo(f"report: {report}")
    typer.echo(f"{plural(len(made.dataset.trajectories), 'simulated trajectory')}: {output}")
    print_ending(f"{output} is a data set like any other", "see what it tells", "omnibench", "inspect", output)
