"""The commands: parse, call, print. What a mistake ends in is __main__'s."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic import BaseModel

from omnibench.cli.guide_commands import guide_app
from omnibench.cli.live_commands import live_app
from omnibench.cli.options import Plugins, load_given_plugins
from omnibench.cli.terminal import calibration_tables as terminal
from omnibench.config import parse_settings, to_json, validate
from omnibench.errors import ConfigError
from omnibench.registry import calibrators, costs, effects, importers

app = typer.Typer(
    name="omnibench",
    help="Calibrate the odometry of robots on omnidirectional wheels, compare calibrators, run the result.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    add_completion=False,
)
plugin_app = typer.Typer(help="Write a plug-in, or check one.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(plugin_app, name="plugin")
app.add_typer(live_app)
app.add_typer(guide_app)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option, value in YAML; may be repeated.")
]


@app.command()
def compare(
    config: Annotated[Path, typer.Argument(help="A comparison in YAML.")],
    output: Annotated[
        Path | None, typer.Option("--output", help="Folder for results; runs that are there are kept.")
    ] = None,
    data: Annotated[
        list[str] | None, typer.Option("--data", metavar="[NAME=]PATH", help="Where the data (set NAME) is.")
    ] = None,
    plugins: Annotated[
        list[Path] | None, typer.Option("--plugins", help="Folder of plug-ins besides the config's; may be repeated.")
    ] = None,
) -> None:
    """Run every calibrator of a config on the same data and budget; score them and write a report."""
    from omnibench.cli.terminal.comparison_tables import Bars, Lines, print_result
    from omnibench.compare.plan import read_compare_config
    from omnibench.compare.run import run_comparison

    chosen = read_compare_config(config, _named_paths(data))
    folders = [*chosen.plugins, *(folder.resolve() for folder in plugins or [])]
    chosen = chosen.model_copy(update={"plugins": tuple(dict.fromkeys(folders))})
    console = terminal.make_console(error=True)
    watch: Bars | Lines = Bars(console) if console.is_terminal else Lines(console)
    with watch:
        result = run_comparison(chosen, output, watch)
    _warn(result.warnings)
    out = terminal.make_console()
    print_result(out, result)
    out.print(f"report: {result.output / 'report.html'}", highlight=False, soft_wrap=True)
    if all(run.matrix is None for run in result.runs):
        raise typer.Exit(1)


@app.command()
def calibrate(
    dataset: Annotated[Path, typer.Argument(help="A data set folder.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="The calibration file to write.")] = None,
    calibrator: Annotated[str, typer.Option(help="See omnibench list.")] = "closed_form",
    cost: Annotated[str, typer.Option(help="See omnibench list.")] = "final_pose",
    parameterisation: Annotated[
        Literal["matrix", "geometry"] | None, typer.Option(help="What is searched. Default: the calibrator's own.")
    ] = None,
    box: Annotated[Literal["paper", "row"], typer.Option(help="paper: +-10 % of each element; row: wider.")] = "row",
    integration: Annotated[Literal["euler", "arc"], typer.Option(help="Euler: the paper's step.")] = "arc",
    seed: Annotated[int, typer.Option(min=0)] = 1,
    evaluations: Annotated[int, typer.Option(min=1, help="Budget.")] = 60_000,
    seconds: Annotated[float, typer.Option(min=0.001, help="Budget.")] = 600.0,
    intervals: Annotated[bool, typer.Option("--intervals", help="Also bootstrap intervals (closed_form).")] = False,
    unidentified: Annotated[
        Literal["keep", "fit"],
        typer.Option(help="Motions that the data hardly drive: keep the design values, or fit them to slip and noise."),
    ] = "keep",
    settings: Settings = None,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Fit the odometry model of a data set's training split and write the calibration file."""
    from omnibench.data.storage import load_dataset
    from omnibench.fit.calibrate import calibrate as fit
    from omnibench.fit.problem import Budget
    from omnibench.robot.calibration import write_calibration

    load_given_plugins(plugins)
    calibrators.entry(calibrator, "--calibrator")
    costs.entry(cost, "--cost")
    if output is None and not as_json:
        raise ConfigError("say where the calibration goes: -o calibration.yaml")
    recordings = load_dataset(dataset)
    with redirect_stdout(sys.stderr), terminal.EvaluationsBar(calibrator, evaluations) as watch:
        run = fit(
            recordings,
            calibrator,
            options=parse_settings(settings),
            cost=cost,
            parameterisation=parameterisation,
            box=box,
            integration=integration,
            budget=Budget(evaluations=evaluations, seconds=seconds),
            seed=seed,
            intervals=intervals,
            unidentified=unidentified,
            watch=watch,
        )
    calibration, result = run.calibration, run.result
    if output is not None:
        write_calibration(calibration, output)
    _warn([*recordings.warnings, *run.warnings])
    if result.at_bounds:
        _warn([f"{', '.join(result.at_bounds)} lie on a bound of the box {box!r}; a wider box may fit better"])
    if result.held:
        _warn([f"{', '.join(result.held)} keep their start values (box {box!r}, cost {cost!r})"])
    if as_json:
        return _print_json(calibration)
    terminal.print_calibration(terminal.make_console(), run)
    typer.echo(f"calibration: {output}")
    return None


@app.command()
def evaluate(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="A data set folder.")],
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Cost and final errors of a calibration on a data set."""
    from omnibench.data.storage import load_dataset
    from omnibench.fit.evaluate import evaluate as judge
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    recordings = load_dataset(dataset)
    evaluation = judge(read_calibration(calibration), recordings)
    warnings = [*recordings.warnings, *evaluation.warnings]
    _warn(warnings)
    if as_json:
        document: dict[str, Any] = {"dataset": evaluation.dataset, "trajectories": evaluation.trajectories}
        document["splits"] = {
            name: errors.model_dump(exclude={"trajectories"}) for name, errors in evaluation.splits.items()
        }
        return _print_json(document | {"warnings": warnings})
    return terminal.print_evaluation(terminal.make_console(), evaluation)


@app.command()
def certify(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="A data set folder.")],
    box: Annotated[
        Literal["paper", "row"] | None,
        typer.Option(help="paper: +-10 % of each element; row: wider. Default: the box it was searched in, or row."),
    ] = None,
    gap: Annotated[float, typer.Option(min=1e-9, max=0.999, help="Stop when this share of the cost is left.")] = 1e-3,
    seconds: Annotated[float, typer.Option(min=0.0, help="Or after this time; what is proven by then holds.")] = 60.0,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Prove how much better than a calibration any matrix of the box could be, on the training split."""
    from omnibench.data.storage import load_dataset
    from omnibench.fit.certify import certify_optimum
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    recordings = load_dataset(dataset)
    with terminal.ProofLine() as watch:
        certified = certify_optimum(
            read_calibration(calibration), recordings, box=box, gap=gap, seconds=seconds, watch=watch
        )
    _warn(recordings.warnings)
    if not certified.inside:
        _warn([f"the calibration is outside the box {certified.certificate.box!r}, of which the bound speaks"])
    if as_json:
        return _print_json(certified.certificate)
    return terminal.print_certificate(terminal.make_console(), certified)


@app.command()
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
        return _print_json(found)
    print_design(terminal.make_console(), found)
    if output is not None:
        typer.echo(f"report: {output / 'report.html'}")
    return None


@app.command()
def discover(
    dataset: Annotated[Path, typer.Argument(help="A data set folder.")],
    model: Annotated[
        Path | None,
        typer.Option("--model", metavar="CALIBRATION", help="Start from this calibration. Default: fit a matrix."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", help="Folder for results. Default: results/NAME/TIME, and a link latest.")
    ] = None,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="NAME", help="An effect not to try; may be repeated.")
    ] = None,
    unknown_term: Annotated[
        bool,
        typer.Option("--unknown-term", help="Where nothing in the catalogue fits: close the gap by a smooth function."),
    ] = False,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Find where odometry and reference disagree, name the missing effect, add it, show how much better that is."""
    from omnibench.cli.terminal.discovery_summary import Stages, print_discovery
    from omnibench.data.storage import load_dataset
    from omnibench.discover.discover import discover_effects
    from omnibench.discover.document import discovery_document
    from omnibench.discover.output import DiscoverOptions, check_output, write_discovery
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    for name in without or ():
        effects.entry(name, "--without")
    check_output(output)
    start = None if model is None else read_calibration(model)
    recordings = load_dataset(dataset)
    with redirect_stdout(sys.stderr), Stages(terminal.make_console(error=True)) as watch:
        found = discover_effects(
            recordings,
            without=tuple(without or ()),
            unknown_term=unknown_term,
            seed=seed,
            watch=watch,
            calibration=start,
        )
        watch.stage("writing the report")
        options = DiscoverOptions(
            dataset=str(dataset),
            model=None if model is None else str(model),
            without=tuple(without or ()),
            unknown_term=unknown_term,
            seed=seed,
            plugins=tuple(map(str, plugins or ())),
        )
        folder = write_discovery(found, options, output)
    _warn(recordings.warnings)
    if as_json:
        return _print_json(discovery_document(found, folder))
    return print_discovery(terminal.make_console(), found, folder)


@app.command()
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
    table_format: Annotated[
        Literal["parquet", "csv"], typer.Option("--format", help="Format of the tables.")
    ] = "parquet",
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Pictures of the recording and of what is hidden in it.")
    ] = None,
    plugins: Plugins = None,
) -> None:
    """Simulate the data set of a config, or a recording's own wheels; the truth goes to another folder, or nowhere."""
    from omnibench.cli.terminal.slam_summary import print_slam_accuracy
    from omnibench.report.recording.section import write_recording_report
    from omnibench.simulate.simulation_request import SimulationRequest

    hidden = tuple(effects or ())
    request = SimulationRequest(output, config, truth, dataset, hidden, like, model, noise, seed)
    load_given_plugins([*(plugins or []), *request.plugins] or None)
    with terminal.Steps(terminal.make_console(error=True)) as watch:
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
    _warn(made.dataset.warnings)
    if made.accuracy is not None:
        print_slam_accuracy(terminal.make_console(), made.accuracy)
    if truth is not None:
        typer.echo(f"truth: {truth / 'truth.yaml'}")
    if report is not None:
        typer.echo(f"report: {report}")
    typer.echo(f"{len(made.dataset.trajectories)} simulated trajectories: {output}")


@app.command()
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
    table_format: Annotated[
        Literal["parquet", "csv"], typer.Option("--format", help="Format of the tables.")
    ] = "parquet",
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Reference poses from the recorded scans of a data set, by scan matching against a growing map."""
    from omnibench.cli.terminal.slam_summary import print_slam
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
    with terminal.Steps(terminal.make_console(error=True)) as watch:
        found = request.run(watch, table_format)
        if report is not None:
            watch("writing the report", 0, 1)
            write_recording_report(found.dataset, report, truth=found.truth, accuracy=found.accuracy)
            watch("writing the report", 1, 1)
    _warn(found.summary.warnings)
    if as_json:
        return _print_json(found.summary)
    print_slam(terminal.make_console(), found.summary)
    for what, file in (("report", report), (f"{found.summary.runs} trajectories", output)):
        if file is not None:
            typer.echo(f"{what}: {file}")
    return None


@app.command("import")
def import_(
    importer: Annotated[str, typer.Argument(metavar="FORMAT", help="See omnibench list.")],
    source: Annotated[Path, typer.Argument(help="File or folder of recordings.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The data set folder to write.")],
    settings: Settings = None,
    table_format: Annotated[
        Literal["parquet", "csv"], typer.Option("--format", help="Format of the tables.")
    ] = "parquet",
    plugins: Plugins = None,
) -> None:
    """Turn recordings into a data set."""
    from omnibench.data.storage import save_dataset
    from omnibench.slam.import_dataset import import_dataset

    load_given_plugins(plugins)
    importers.entry(importer, "import")
    dataset = import_dataset(importer, source, parse_settings(settings))
    save_dataset(dataset, output, table_format)
    _warn(dataset.warnings)
    typer.echo(f"{len(dataset.trajectories)} trajectories: {output}")


@app.command()
def export(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    to: Annotated[str, typer.Option("--to", help="ros2_controllers or c_header.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; default: standard output.")
    ] = None,
    plugins: Plugins = None,
) -> None:
    """Write a calibration for other software."""
    from omnibench.files import write_text
    from omnibench.robot.calibration import read_calibration
    from omnibench.robot.export.formats import export_calibration

    load_given_plugins(plugins)
    exported = export_calibration(read_calibration(calibration), to)
    _warn(exported.warnings)
    if output is None:
        typer.echo(exported.text, nl=False)
    else:
        file = output / exported.file_name if output.is_dir() else output
        write_text(file, exported.text)
        typer.echo(f"{to}: {file}")


@app.command()
def inspect(dataset: Annotated[Path, typer.Argument(help="A data set folder.")], as_json: Json = False) -> None:
    """What is in a data set, and what can be identified from it."""
    from omnibench.data.storage import load_dataset
    from omnibench.fit.inspect import inspect_dataset

    found = inspect_dataset(load_dataset(dataset))
    if as_json:
        return _print_json(found)
    terminal.print_inspection(terminal.make_console(), found)
    return _warn(found.warnings)


@app.command("list")
def list_(plugins: Plugins = None, as_json: Json = False) -> None:
    """Calibrators, effects, costs and importers, and where each comes from."""
    failures = load_given_plugins(plugins)
    if as_json:
        return _print_json(terminal.registry_document(failures))
    return terminal.print_registries(terminal.make_console())


_CONFIGS = {
    "compare": ("omnibench.compare.config", "CompareConfig"),
    "design": ("omnibench.design.config", "DesignConfig"),
    "live": ("omnibench.live.config", "LiveConfig"),
    "simulate": ("omnibench.simulate.source", "SimulationConfig"),
}


@app.command()
def schema(
    kind: Annotated[
        Literal["compare", "design", "live", "simulate"], typer.Argument(help="Configs of which command.")
    ] = "compare",
) -> None:
    """JSON schema of the configs, for editors."""
    module, name = _CONFIGS[kind]
    config: type[BaseModel] = getattr(import_module(module), name)
    _print_json(config.model_json_schema(by_alias=True))


@plugin_app.command("new")
def plugin_new(
    name: Annotated[str, typer.Argument(help="Its name in configs.")],
    kind: Annotated[str | None, typer.Option(help="calibrator (the default), importer, cost or effect.")] = None,
    effect: Annotated[bool, typer.Option("--effect", help="The same as --kind effect.")] = False,
    folder: Annotated[Path, typer.Option(help="Where it goes.")] = Path("plugins"),
) -> None:
    """Write a working plug-in and its test."""
    from omnibench.testing.plugin_files import new_plugin

    if effect and kind not in (None, "effect"):
        raise ConfigError(f"--effect and --kind {kind} contradict each other; leave one out")
    for file in new_plugin(name, "effect" if effect else kind or "calibrator", folder):
        typer.echo(f"written: {file}")
    typer.echo(f"check it: omnibench plugin check {folder / name}.py")


@plugin_app.command("check")
def plugin_check(
    file: Annotated[Path, typer.Argument(help="A plug-in file.")],
    sample: Annotated[Path | None, typer.Option(help="Recordings for an importer to read.")] = None,
) -> None:
    """Run the conformance tests on a plug-in; exit code 1 when one fails."""
    from omnibench.testing.plugin_files import check_plugin

    report = check_plugin(file, sample)
    for result in report.results:
        message = f": {result.message}" if result.message else ""
        typer.echo(f"{result.outcome:7} {result.kind} {result.name}: {result.case}{message}")
    counts = Counter(str(result.outcome) for result in report.results)
    typer.echo(", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    if report.failures:
        raise typer.Exit(1)


def _warn(messages: Iterable[str]) -> None:
    for message in messages:
        typer.echo(f"warning: {message}", err=True)


def _print_json(document: Mapping[str, Any] | BaseModel) -> None:
    typer.echo(to_json(document))


def _named_paths(data: list[str] | None) -> dict[str, Path]:
    """``[NAME=]PATH`` pairs; a path that exists as it stands needs no name."""
    paths = {}
    for item in data or []:
        name, equals, location = item.partition("=")
        if Path(item).exists() or not equals:
            name, location = "", item
        if not Path(location).exists():
            raise ConfigError(f"--data {item}: no such file or folder")
        paths[name] = Path(location)
    return paths
