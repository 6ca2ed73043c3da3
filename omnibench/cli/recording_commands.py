"""``import``, ``inspect``, ``design``, ``simulate`` and ``slam``: recordings, and what to record."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from omnibench.cli.options import Json, Plugins, Settings, TableFormat, load_given_plugins
from omnibench.cli.terminal.console import make_console, print_json, warn
from omnibench.errors import ConfigError

if TYPE_CHECKING:
    pass

recording_app = typer.Typer()


@recording_app.command("import")
def import_(
    importer: Annotated[str, typer.Argument(metavar="FORMAT", help="See omnibench list.")],
    source: Annotated[Path, typer.Argument(help="File or folder of recordings.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The data set folder to write.")],
    settings: Settings = None,
    table_format: TableFormat = "parquet",
    plugins: Plugins = None,
) -> None:
    """Turn recordings into a data set."""
    from omnibench.config import parse_settings
    from omnibench.data.storage import save_dataset
    from omnibench.registry import importers
    from omnibench.slam.import_dataset import import_dataset

    load_given_plugins(plugins)
    importers.entry(importer, "import")
    dataset = import_dataset(importer, source, parse_settings(settings))
    save_dataset(dataset, output, table_format)
    warn(dataset.warnings)
    typer.echo(f"{len(dataset.trajectories)} trajectories: {output}")


@recording_app.command()
def inspect(dataset: Annotated[Path, typer.Argument(help="A data set folder.")], as_json: Json = False) -> None:
    """What is in a data set, and what can be identified from it."""
    from omnibench.cli.terminal.inspection_tables import print_inspection
    from omnibench.data.storage import load_dataset
    from omnibench.fit.inspect import inspect_dataset

    found = inspect_dataset(load_dataset(dataset))
    if as_json:
        return print_json(found)
    print_inspection(make_console(), found)
    return warn(found.warnings)


@recording_app.command()
def design(
    source: Annotated[
        Path, typer.Argument(metavar="DATASET|CONFIG", help="A data set folder, or a comparison's or design's YAML.")
    ],
    use: Annotated[
        Literal["trajectory", "final"], typer.Option(help="Reference poses that a calibration is made from.")
    ] = "trajectory",
    per: Annotated[Literal["run", "second", "metre"], typer.Option(help="What is to be spared.")] = "run",
    runs: Annotated[int | None, typer.Option(min=1, help="Choose so many. Default: within 1 % of the optimum.")] = None,
    repetitions: Annotated[int | None, typer.Option(min=1, help="How often a command may be chosen.")] = None,
    dataset: Annotated[str | None, typer.Option(help="Which data set, if the config has several.")] = None,
    integration: Annotated[
        Literal["euler", "arc"] | None, typer.Option(help="Default: the config's, or arc for a data set.")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", help="Folder for report.html and design.json.")] = None,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Which commands are worth driving: the runs that shrink the covariance of the matrix most."""
    from omnibench.cli.terminal.design_summary import print_design
    from omnibench.config import to_json
    from omnibench.design.design import design_experiment
    from omnibench.design.report.design_report import write_design_report
    from omnibench.files import write_text

    load_given_plugins(plugins)
    found = design_experiment(
        source, use=use, per=per, runs=runs, repetitions=repetitions, dataset=dataset, integration=integration
    )
    if output is not None:
        write_text(output / "design.json", to_json(found) + "\n")
        write_design_report(found, output / "report.html")
    if as_json:
        return print_json(found)
    print_design(make_console(), found)
    if output is not None:
        typer.echo(f"report: {output / 'report.html'}")
    return None


@recording_app.command()
def slam(
    dataset: Annotated[Path, typer.Argument(help="A data set folder with scans.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The data set folder to write, with the new poses.")
    ] = None,
    start: Annotated[
        Literal["odometry", "last_pose"] | None, typer.Option(help="Where the search begins. Default: odometry.")
    ] = None,
    no_deskew: Annotated[
        bool, typer.Option("--no-deskew", help="Take each scan as seen from one pose, as if the robot stood.")
    ] = False,
    model: Annotated[
        Path | None, typer.Option(metavar="CALIBRATION", help="Odometry to start from. Default: the design values.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(metavar="DIR", help="What simulate --truth wrote: judge the poses by it.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Pictures of the scans, the paths and the wheels.")
    ] = None,
    settings: Settings = None,
    table_format: TableFormat = "parquet",
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Reference poses from the recorded scans of a data set, by scan matching against a growing map."""
    from omnibench.cli.terminal.progress import Steps
    from omnibench.cli.terminal.slam_summary import print_slam
    from omnibench.config import parse_settings, validate
    from omnibench.report.recording.section import write_recording_report
    from omnibench.slam.slam_options import SlamOptions
    from omnibench.slam.slam_request import SlamRequest

    load_given_plugins(plugins)
    given: dict[str, Any] = {} if start is None else {"start": start}
    given |= {"deskew": False} if no_deskew else {}
    request = SlamRequest(
        dataset, output, validate(SlamOptions, parse_settings(settings) | given, "slam --set"), model, truth
    )
    if output is None and report is None and not as_json:
        raise ConfigError("say where the poses go: -o DATASET; or ask for figures alone: --json, --report FILE.html")
    with Steps(make_console(error=True)) as watch:
        found = request.run(watch, table_format)
        if report is not None:
            watch("writing the report", 0, 1)
            write_recording_report(found.dataset, report, truth=found.truth, accuracy=found.accuracy)
            watch("writing the report", 1, 1)
    warn(found.summary.warnings)
    if as_json:
        return print_json(found.summary)
    print_slam(make_console(), found.summary)
    for what, file in (("report", report), (f"{found.summary.runs} trajectories", output)):
        if file is not None:
            typer.echo(f"{what}: {file}")
    return None


@recording_app.command()
def simulate(
    output: Annotated[Path, typer.Option("-o", "--output", help="The data set folder to write.")],
    config: Annotated[Path | None, typer.Argument(help="A config with a simulated data set.")] = None,
    truth: Annotated[Path | None, typer.Option(help="Folder for what is hidden: the true matrix, effects.")] = None,
    dataset: Annotated[str | None, typer.Option(help="Which data set, if the config has several.")] = None,
    effects: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="YAML", help="Hide it, too: 'name: {parameter: value}'; may be repeated."),
    ] = None,
    like: Annotated[
        Path | None, typer.Option(metavar="DATASET", help="In place of CONFIG: drive its recorded wheels again.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="CALIBRATION", help="With --like: by the model of this calibration.")
    ] = None,
    noise: Annotated[bool, typer.Option("--noise", help="With --like: add the calibration's noise.")] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="With --noise. Default: 0.")] = None,
    table_format: TableFormat = "parquet",
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Pictures of the recording and of what is hidden in it.")
    ] = None,
    plugins: Plugins = None,
) -> None:
    """Simulate the data set of a config, or a recording's own wheels; the truth goes to another folder, or nowhere."""
    from omnibench.cli.terminal.progress import Steps
    from omnibench.cli.terminal.slam_summary import print_slam_accuracy
    from omnibench.report.recording.section import write_recording_report
    from omnibench.simulate.simulation_request import SimulationRequest

    hidden = tuple(effects or ())
    request = SimulationRequest(output, config, truth, dataset, hidden, like, model, noise, seed)
    load_given_plugins([*(plugins or []), *request.plugins] or None)
    with Steps(make_console(error=True)) as watch:
        made = request.write(table_format, watch)
        if report is not None:
            watch("writing the report", 0, 1)
            shown = made.simulation
            write_recording_report(
                made.dataset,
                report,
                truth=shown.paths or None if shown else None,
                plan=shown.plan if shown else None,
                starts=shown.starts if shown else None,
                accuracy=made.accuracy,
            )
    warn(made.dataset.warnings)
    if made.accuracy is not None:
        print_slam_accuracy(make_console(), made.accuracy)
    if truth is not None:
        typer.echo(f"truth: {truth / 'truth.yaml'}")
    if report is not None:
        typer.echo(f"report: {report}")
    typer.echo(f"{len(made.dataset.trajectories)} simulated trajectories: {output}")
