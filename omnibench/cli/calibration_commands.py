"""``compare``, ``calibrate``, ``evaluate``, ``guard``, ``certify``, ``export``, ``discover``: from fit to use."""

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

import omnibench
from omnibench.cli import options as shared
from omnibench.cli.options import argument, flag, names_in, option, options_of, output_option
from omnibench.cli.terminal.console import make_console, print_ending, show, warn
from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.errors import ConfigError, DataError
from omnibench.files import refuse_existing, write_text
from omnibench.progress import Progress

if TYPE_CHECKING:
    from omnibench.compare.config import CompareConfig
    from omnibench.discover.output import DiscoverOptions
    from omnibench.fit.settings import FitSettings


calibration_app = typer.Typer()
_PAGE = shared.report_options("Write a page: before and after, paths, parameters, errors by motion.")
_GUARD_PAGE = shared.report_options("Write a page: alarms, proposals, and the evidence over the way.")


@calibration_app.command()
@shared.grouped
def compare(
    config: list[Path] = argument(
        "Comparison config (YAML), or a data set (its folder, several, a glob) for a quick comparison.",
        ...,
        metavar="CONFIG|DATASET",
    ),
    output: Path | None = output_option(
        "Folder for the results; finished runs in it are kept. Default: results/NAME/TIME."
    ),
    data: list[str] | None = option(
        "Where the recordings of the config's data set NAME are on this disk; of a study, the folder of all.",
        "--data",
        metavar="[NAME=]PATH",
    ),
    jobs: shared.BackendOptions = shared.BackendOptions(
        workers=option("Processes, or Dask workers started here. Default: the config's.", min=1)
    ),
    figures: Path | None = shared.FIGURES,
    everything: bool = flag("Print all tables of the report, not the answer alone.", "--all"),
    added: list[Path] | None = option(
        "Plug-in file whose calibrators are compared, too; the fits of all others are kept for the next one.",
        "--add",
        metavar="FILE.py",
    ),
    traces: Path | None = option("Write the courses of all searches, for IOHinspector.", metavar="DIR"),
    force: bool = shared.FORCE,
    plugins: list[Path] | None = option(
        "Folder of plug-ins besides the config's; may be repeated.", "--plugins", metavar="DIR"
    ),
    as_json: bool = shared.JSON,
) -> None:
    """Run calibrators on equal terms, score them, write a report.

    All calibrators of the config, or all that suit the data set, get the same data and the same budget. A config that
    names robots is a study: every method on several robots and kinds of path. Run again with the same -o, it goes on
    where it was stopped.
    """
    from platformdirs import user_cache_path

    from omnibench.compare.report.comparison_view import ComparisonView
    from omnibench.compare.report.searches import write_traces
    from omnibench.compare.report.view import views

    shared.refuse_figures_without_browser(figures)
    asked = shared.plugin_folders(plugins or [])
    given = {"backend": jobs.backend, "workers": jobs.workers, "tls": jobs.tls}
    chosen = _asked_comparison(config, data, asked)
    folders = tuple(dict.fromkeys([*chosen.plugins, *(folder.resolve() for folder in asked)]))
    chosen = chosen.model_copy(
        update={"plugins": folders} | {name: value for name, value in given.items() if value is not None}
    )
    chosen = _with_added(chosen, added or ())
    if traces is not None and chosen.robots:
        raise ConfigError("--traces is for a comparison on data sets, and this config names robots; leave it out")
    with ProgressDisplay() as watch:
        fits = user_cache_path("omnibench") / "fits" if added else None
        result = omnibench.run_comparison(chosen, output, watch, force=force, cache=fits)
        view = ComparisonView(result, everything=everything)
        if traces is not None:
            files = write_traces(views(result), traces)
            typer.echo(f"traces: {traces} ({len(files)} searches)", err=True)
        if figures is not None:
            watch(Progress("drawing the figures"))
            shared.write_asked_figures(view.document(), figures)
    show(view, as_json)
    if result.nothing_answered or result.broken:
        raise typer.Exit(1)


def _with_added(config: "CompareConfig", files: Sequence[Path]) -> "CompareConfig":
    """The config with an entry for each calibrator of some plug-in files. PluginError: a file has none, or fails."""
    from omnibench.compare.config import CalibratorEntry
    from omnibench.errors import PluginError
    from omnibench.registry import calibrators

    for file in map(Path.resolve, files):
        shared.load_given_plugins([Path("none")], [file])
        names = [entry.name for entry in calibrators.entries() if entry.origin == str(file)]
        if not names:
            raise PluginError(f"{file}: registers no calibrator (omnibench guide plugins)")
        key = "methods" if config.methods else "calibrators"
        entries = (*getattr(config, key), *(CalibratorEntry(name=name) for name in names))
        config = config.model_copy(update={key: entries, "plugins": (*config.plugins, file)})
    return config


def _asked_comparison(given: Sequence[Path], data: list[str] | None, plugins: Sequence[Path]) -> "CompareConfig":
    """The config that is given, or one for the data set that is: its folders, or a glob."""
    from omnibench.compare.config import config_in_words, recording_config
    from omnibench.data.storage import is_glob

    first = given[0]
    of_recordings = all(place.is_dir() or is_glob(place) for place in given)
    if len(given) > 1 and not of_recordings:
        missing = next((place for place in given if not place.exists() and not is_glob(place)), None)
        if missing is not None and any(place.is_dir() for place in given):
            raise DataError(f"{missing}: no such folder; compare takes one config, or the folders of one data set")
        raise ConfigError(
            f"unexpected extra argument {given[1]}; compare takes one config, or the folders of one data set "
            "(see omnibench compare --help)"
        )
    if not of_recordings:
        return omnibench.read_compare_config(first, _named_paths(data))
    if first.is_dir() and not (any(first.glob("dataset.yaml")) or any(first.glob("*/dataset.yaml"))):
        raise ConfigError(f"{first}: is a folder without dataset.yaml; name a config, or the folder of a data set")
    if data:
        raise ConfigError(f"--data is for a config, and {first} is a data set; leave it out")
    comparison = recording_config(given, plugins)
    make_console(error=True).print(config_in_words(comparison), soft_wrap=True)
    return comparison


def _named_paths(data: list[str] | None) -> dict[str, Path]:
    """Paths by the names of data sets, from ``[NAME=]PATH``; a path without a name stands under an empty one."""
    paths = {}
    for item in data or []:
        name, equals, location = item.partition("=")
        if Path(item).exists() or not equals:
            name, location = "", item
        if not Path(location).exists():
            raise ConfigError(f"--data {item}: no such file or folder")
        paths[name] = Path(location)
    return paths


@calibration_app.command(cls=shared.ModelCommand)
@shared.grouped
def calibrate(
    dataset: list[Path] = shared.DATASETS,
    output: Path | None = output_option("Calibration file to write. Default: it is only shown.", metavar="FILE.yaml"),
    asked: "FitSettings" = options_of("omnibench.fit.settings:FitSettings"),
    page: shared.ReportOptions = _PAGE,
    jobs: shared.BackendOptions = shared.BackendOptions(),
    settings: list[str] | None = shared.SETTINGS,
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Fit a robot's odometry model; write it with -o.

    The fit uses the training split of the data set, and never its validation split.
    """
    from omnibench.config import parse_settings, to_yaml
    from omnibench.registry import calibrators, costs
    from omnibench.report.calibration_report import CalibrationResult

    shared.load_given_plugins(plugins)
    chosen = asked.model_copy(update={"options": parse_settings(settings)})
    if chosen.calibrator is not None:
        calibrators.entry(chosen.calibrator, "--calibrator")
    if chosen.cost is not None:
        costs.entry(chosen.cost.name, "--cost")
    refuse_existing(output, force=force)
    page.refuse(force=force)
    with redirect_stdout(sys.stderr), ProgressDisplay() as watch, jobs.opened(watch) as backend:
        recordings = omnibench.load_dataset(dataset)
        run = omnibench.calibrate(recordings, chosen, watch=watch, backend=backend)
    if output is not None:
        write_text(output, to_yaml(run.calibration))
    again = ("omnibench", *sys.argv[1:], "-o", "calibration.yaml")
    result = CalibrationResult(run, recordings, file=output, sources=dataset, again=again, box=chosen.box)
    page.write(result.page, announced=True)
    show(result, as_json)


@calibration_app.command()
@shared.grouped
def evaluate(
    calibration: Path = shared.CALIBRATION,
    dataset: list[Path] | None = argument(
        "Data set folder; several of one robot, or a glob, count as one.", metavar="DATASET..."
    ),
    paths: list[str] | None = option(
        'Path to predict errors for: "straight 1.0" (m), "turn 360" (deg), "circle 1.0 left" (its radius), '
        '"square 1.0 right" (its side); may be repeated.',
        "--path",
        metavar="PATH",
    ),
    page: shared.ReportOptions = _PAGE,
    jobs: shared.BackendOptions = shared.BackendOptions(),
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Show a calibration's errors on a data set, and those on paths.

    On each split: the cost, and the errors of the final pose, beside those of the robot's design values. On each path:
    the expected error at its end and the region that holds 95 % of errors. Without DATASET the paths alone.
    """
    from omnibench.fit.path_errors import predicted_errors, regions_lack
    from omnibench.report.calibration_report import EvaluationResult

    shared.load_given_plugins(plugins)
    page.refuse(force=force)
    if not dataset and page.asked:
        raise ConfigError("--report and --figures show recordings: name a data set, too")
    with ProgressDisplay() as watch, jobs.opened(watch):
        evaluated = omnibench.read_calibration(calibration)
        predicted = predicted_errors(evaluated, paths or ())
        recordings = omnibench.load_dataset(dataset) if dataset else None
        evaluation = None if recordings is None else omnibench.evaluate(evaluated, recordings)
    warnings = [lack] if (lack := regions_lack(evaluated)) else []
    if recordings is not None and evaluation is not None:
        warnings = [*recordings.warnings, *evaluation.warnings, *warnings]
    result = EvaluationResult(evaluation, evaluated, predicted, recordings, calibration, dataset or (), warnings)
    page.write(result.page, announced=True)
    show(result, as_json)


@calibration_app.command()
@shared.grouped
def guard(
    dataset: list[Path] = shared.DATASETS,
    calibration: Path = option("Calibration that the robot drives by.", default=..., metavar="FILE"),
    output: Path | None = output_option("Where to write the calibration with the accepted changes.", metavar="FILE"),
    page: shared.ReportOptions = _GUARD_PAGE,
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Say what changed since a calibration, when, and what to do.

    The motion between reference poses is compared with what the calibration predicts, run after run, as a node does
    while the robot drives: the radius of a wheel, the track, a steering zero, a slipping wheel, a silent encoder, the
    reference's scale, jumps and clock, the floor.
    """
    from omnibench.cli.terminal.guard_result import GuardResult
    from omnibench.config import to_yaml
    from omnibench.live.guarding import watch_recording

    shared.load_given_plugins(plugins)
    refuse_existing(output, force=force)
    page.refuse(force=force)
    with ProgressDisplay() as watch:
        recordings = omnibench.load_dataset(dataset)
        report, watching = watch_recording(omnibench.read_calibration(calibration), recordings, watch)
    written = None
    if output is not None and report.proposed is not None:
        write_text(written := output, to_yaml(report.proposed))
    result = GuardResult(report, watching, recordings.name, recordings.simulated, calibration, dataset, written, output)
    page.write(result.page, announced=True)
    show(result, as_json)


@calibration_app.command()
@shared.grouped
def certify(
    calibration: Path = shared.CALIBRATION,
    dataset: list[Path] = shared.DATASETS,
    box: Literal["paper", "row"] | None = option(
        "Matrices to compare with; see calibrate. Default: the box of the calibration's search."
    ),
    gap: float = option("Stop once at most this share of the cost could be saved.", default=1e-3, min=1e-9, max=0.999),
    seconds: float = option("Stop after this time, in s; the bound proven by then holds.", default=60.0, min=0.0),
    parts: int | None = option("Stop after so many parts of the box: a limit that no machine changes.", min=1),
    jobs: shared.BackendOptions = shared.BackendOptions(),
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Prove how far a calibration's cost is from the lowest possible.

    Gives a lower bound on the cost of every matrix in the box, on the training split, whatever the optimiser.
    """
    from omnibench.report.certificate import CertificateResult

    shared.load_given_plugins(plugins)
    with ProgressDisplay() as watch, jobs.opened(watch, "omnibench.fit.certify") as backend:
        recordings = omnibench.load_dataset(dataset)
        certified = omnibench.certify_optimum(
            omnibench.read_calibration(calibration), recordings, box=box, gap=gap, seconds=seconds, parts=parts,
            watch=watch, backend=backend,
        )  # fmt: skip
    show(CertificateResult(certified, calibration, dataset), as_json)


@calibration_app.command()
def export(
    calibration: Path = shared.CALIBRATION,
    to: str = option(
        "ros2_controllers, robot_localization or c_header.",
        "--to",
        default=...,
        metavar="FORMAT",
        autocompletion=names_in("omnibench.robot.export.formats:EXPORT_FORMATS"),
    ),
    output: Path | None = output_option("File or folder to write to. Default: standard output."),
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
) -> None:
    """Convert a calibration for ROS 2 or C programs.

    ros2_controllers takes the controller of the robot's kind, and says what it cannot hold of the calibration.
    """
    from omnibench.errors import visible

    shared.load_given_plugins(plugins)
    exported = omnibench.export_calibration(omnibench.read_calibration(calibration), to)
    file = output / exported.file_name if output is not None and output.is_dir() else output
    refuse_existing(file, force=force)
    # What is printed holds its warnings, which a terminal need not show twice
    warn([warning for warning in exported.warnings if file is not None or warning not in exported.text])
    if file is None:
        typer.echo(visible(exported.text), nl=False)
        print_ending(f"{to}: printed, not written", "write it to a file with -o FILE")
    else:
        write_text(file, exported.text)
        print_ending(f"{file} is written for {to}", "load it where the robot's odometry is computed")


@calibration_app.command(cls=shared.ModelCommand)
@shared.grouped
def discover(
    dataset: Path = argument("Data set folder.", ...),
    options: "DiscoverOptions" = options_of("omnibench.discover.output:DiscoverOptions"),
    output: Path | None = output_option("Folder for the results. Default: results/NAME/TIME."),
    figures: Path | None = shared.FIGURES,
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Find and name the physics that a robot's model lacks.

    Shows where odometry and reference disagree, names the effect that explains it, adds it to the calibration, and
    tells how much smaller the error becomes on runs that were held out.
    """
    from omnibench.config import to_yaml
    from omnibench.discover.output import check_output, write_discovery
    from omnibench.discover.report.discovery_report import discovery_report
    from omnibench.discover.report.discovery_result import DiscoveryResult
    from omnibench.registry import effects

    shared.refuse_figures_without_browser(figures)
    shared.load_given_plugins(plugins)
    for name in options.without:
        effects.entry(name, "--without")
    check_output(output, options, force=force)
    start = None if options.model is None else omnibench.read_calibration(options.model)
    recordings = omnibench.load_dataset(dataset)
    chosen = options.model_dump(include={"without", "unknown_term", "seed"})
    with redirect_stdout(sys.stderr), ProgressDisplay() as watch:
        discovery = omnibench.discover_effects(recordings, **chosen, watch=watch, calibration=start)
        watch(Progress("writing the report"))
        folder = write_discovery(discovery, options, output, force=force)
        if figures is not None:
            shared.write_asked_figures(discovery_report(discovery, to_yaml(options)), figures)
    show(DiscoveryResult(discovery, folder), as_json)
