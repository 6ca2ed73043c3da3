"""``import``, ``fetch``, ``check``, ``inspect``, ``design``, ``slam`` and ``simulate``: recordings, old and new."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer
from typer.core import TyperCommand

import omnibench
from omnibench.cli import options as shared
from omnibench.cli.options import IMPORTER_NAMES, argument, flag, names_in, option, options_of, output_option
from omnibench.cli.terminal.console import make_console, print_ending, print_names, say, show, warn
from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.errors import ConfigError, DataError
from omnibench.files import refuse_existing, resolved, write_text
from omnibench.progress import Progress
from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.check.check import CheckReport
    from omnibench.design.candidates import DesignRequest
    from omnibench.simulate.source import SimulationRequest
    from omnibench.slam.slam_dataset import SlamRequest


recording_app = typer.Typer()


class HelpOfImporters(TyperCommand):
    """The command ``import``, whose help after the name of a format is that importer's."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Print the importer's help where ``FORMAT --help`` was typed; else as any command."""
        if "--help" in args:
            given, _, _ = self.make_parser(ctx).parse_args(args=[each for each in args if each != "--help"])
            if (name := given.get("importer")) is not None:
                from omnibench.cli.terminal.importer_help import importer_help

                folders = [Path(folder) for folder in given.get("plugins") or ()]
                files = [Path(file) for file in given.get("plugin_files") or ()]
                shared.load_given_plugins(folders or None, files)
                typer.echo(importer_help(str(name), ctx.command_path))
                ctx.exit()
        return super().parse_args(ctx, args)


@recording_app.command("import", cls=HelpOfImporters)
def import_(
    importer: str = argument(
        "Format of the recordings; import FORMAT --help shows its options.",
        ...,
        metavar="FORMAT",
        autocompletion=IMPORTER_NAMES,
    ),
    source: Path | None = argument("File or folder with the recordings."),
    output: Path | None = output_option("Data set folder to write."),
    settings: list[str] | None = shared.SETTINGS,
    accept_units: bool = flag("Write the data set even if units look wrong by magnitude.", "--accept-units"),
    template: Path | None = option("csv, without SOURCE: write tables and robot.yaml to fill in.", metavar="DIR"),
    robot_type: Literal["diff", "omni3", "mecanum", "tricycle", "car", "swerve", "skid"] | None = option(
        "With --template: the robot's type. Default: diff."
    ),
    references: bool = flag(
        "With --template: distances and turned angles, measured by hand, instead of poses.", "--references"
    ),
    no_check: bool = flag("Leave out the check of what was recorded.", "--no-check"),
    table_format: shared.TableFormat = shared.TABLE_FORMAT,
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    plugin_files: list[Path] | None = option("One plug-in file to load; may be repeated.", "--plugin", metavar="FILE"),
) -> None:
    """Convert recordings into a data set.

    omnibench import FORMAT --help lists the options of a format, which --set takes. Formats: csv (tables of any
    robot), rosbag, dataset (a data set again, with other options), table1, optiodom and plug-ins. Recordings with laser
    scans but without reference poses get these by SLAM.
    """
    from omnibench.config import parse_settings
    from omnibench.data.dataset import Imported
    from omnibench.data.finding import UNITS
    from omnibench.data.runs import division_in_words
    from omnibench.data.storage import check_dataset_folder, save_dataset
    from omnibench.progress import reading_told_to
    from omnibench.registry import importers

    shared.load_given_plugins(plugins, plugin_files)
    entry, given = importers.entry(importer, "import"), parse_settings(settings)
    if template is not None:
        if importer != "csv":
            raise ConfigError(f"--template is for csv, not for {importer}: omnibench import csv --template {template}")
        if source is not None or output is not None:
            raise ConfigError("--template DIR writes tables to fill in; leave SOURCE and -o out")
        refuse_existing(template, force=force, folders=True)
        from omnibench.data.importers.csv_template import write_template

        files = write_template(template, robot_type or "diff", references=references)
        typer.echo(f"{plural(len(files), 'file')}: {template}")
        for file in files:
            typer.echo(f"  {file.name}", err=True)
        return print_ending(
            f"{template} holds robot.yaml and {plural(len(files) - 1, 'table')} to fill in",
            "put your robot and your samples into them, and import them",
            *("omnibench", "import", "csv", template, "-o", f"data/{template.resolve().name}"),
        )
    if references:
        raise ConfigError("--references is for --template DIR; a references.csv among the tables is read by itself")
    if robot_type is not None:
        raise ConfigError("--robot-type is for --template DIR; the robot of a recording is --set robot=FILE")
    if source is None or output is None:
        lacking = "SOURCE, the file or folder with the recordings" if source is None else "-o DIR, the folder to write"
        raise ConfigError(f"import {importer}: say {lacking}: omnibench import {importer} SOURCE -o DIR")
    check_dataset_folder(output)
    if source.exists() and resolved(output) == source.resolve():
        raise ConfigError(f"{output} is the source; name another folder with -o")
    refuse_existing(output, force=force, folders=True)
    options, folder = dict(given), output.resolve().name
    if "name" in entry.cls.Options.model_fields and folder.isprintable() and folder:
        options.setdefault("name", folder)
    with ProgressDisplay() as watch, reading_told_to(watch):
        dataset = omnibench.import_dataset(importer, source, options)
        report: CheckReport | None = None
        if not no_check:
            from omnibench.check.check import check_recording  # slow to import
            from omnibench.check.source import RecordingSource

            report = check_recording(RecordingSource(dataset, importer, source, given, output))
    if not accept_units and report is not None:
        # Units that cannot be right are refused, with what to type.
        wrong = [finding.what for finding in report.findings if finding.severity == "error" and finding.kind in UNITS]
        if wrong:
            way = f"type {report.command}, or " if report.command else ""
            raise DataError(f"{'; '.join(wrong)}; {output} is not written: {way}--accept-units to write it as it is")
    dataset = replace(dataset, imported=Imported.of(importer, source, given))
    save_dataset(dataset, output, table_format, overwrite=force)
    warn(dataset.warnings)
    typer.echo(f"{plural(len(dataset.trajectories), 'trajectory')}: {output}")
    way = " (other: --set validation=PATTERN)" if "validation" in entry.cls.Options.model_fields else ""
    divided = f"{division_in_words(dataset.robot, dataset.trajectories, options)}{way}"
    make_console(error=True).print(divided, soft_wrap=True)
    if report is not None:
        make_console(error=True).print(f"check: {report.sentence}.", soft_wrap=True)
    holds = f"{output} holds {plural(len(dataset.trajectories), 'run')} of {dataset.robot.name}"
    if report is None:
        return print_ending(holds, "see what they tell", "omnibench", "inspect", output)
    if report.command:
        then = "mend what it warns of" if report.verdict == "ready" else "mend it"
        return print_ending(holds, then, *shlex.split(report.command))
    if report.verdict == "ready":
        return print_ending(holds, "calibrate it", "omnibench", "calibrate", output, "-o", "calibration.yaml")
    return print_ending(holds, "see what is missing", "omnibench", "check", output)


@recording_app.command()
def fetch(
    name: str | None = argument(
        "One of the list that is shown without it, or any OWNER/REPO on GitHub.",
        autocompletion=names_in("omnibench.cli.fetch:known_names"),
    ),
    output: Path | None = output_option(
        "Data set folder to write; of several data sets, the folder above. Default: data/NAME."
    ),
    commit: str | None = option("Commit to take; HEAD: the newest. Default: the one that was tested.", metavar="SHA"),
    force: bool = shared.FORCE,
) -> None:
    """Clone a public recording from GitHub and import it.

    Your git clones it into ./clones; a clone that is there is used again. Without NAME: the list of known recordings.
    """
    from omnibench.cli.fetch import GITHUB, RECORDINGS, fetch_recording

    if name is None:
        for recording in RECORDINGS:
            typer.echo(f"{recording.repository} ({recording.licence}); reference: {recording.reference}")
            print_names({listed.name: f"{listed.robot}: {listed.runs}" for listed in recording.datasets}, 10)
        print_ending("these are the public recordings that are known", "fetch one", "omnibench", "fetch", "omni3")
        return None
    with ProgressDisplay() as watch:
        fetched = fetch_recording(name, output, commit=commit, force=force, report=watch)
    for folder, imported in fetched.datasets.items():
        warn(f"{folder}: {warning}" for warning in imported.warnings)
        typer.echo(f"{plural(len(imported.trajectories), 'trajectory')}: {folder}")
    first, dataset = next(iter(fetched.datasets.items()), (fetched.folder, None))
    text = "" if fetched.licence_file is None else f" ({first / fetched.licence_file.name})"
    say(f"source: {fetched.source}, in {fetched.folder}")
    say(f"licence: {fetched.licence or 'the repository states none; ask its authors before you use it'}{text}")
    say(f"cite: {fetched.recording.article or f'{GITHUB}/{fetched.recording.repository}'}")
    if dataset is not None:
        holds = f"{first} holds {plural(len(dataset.trajectories), 'run')} of {dataset.robot.name}"
        return print_ending(holds, "see whether they are fit for calibration", "omnibench", "check", first)
    make_console(error=True).print(f"not imported: {fetched.refusal}", soft_wrap=True)
    holds = f"{fetched.folder} holds {fetched.recording.repository}"
    if not fetched.importer:
        return print_ending(holds, "see what can be imported", "omnibench", "list", "importers")
    return print_ending(holds, "see what its import needs", "omnibench", "import", fetched.importer, "--help")


@recording_app.command()
@shared.grouped
def check(
    source: list[Path] = argument(
        "Data set folder, or several; folder or file of CSV tables, or a bag.", ..., metavar="SOURCE..."
    ),
    importer: str | None = option(
        "Importer of the source. Default: by its files.", "--format", metavar="NAME", autocompletion=IMPORTER_NAMES
    ),
    robot: Path | None = option("robot.yaml, where the source does not say the robot.", metavar="FILE"),
    settings: list[str] | None = shared.SETTINGS,
    page: shared.ReportOptions = shared.report_options("Write a page with figures of clocks and findings."),
    plugin: list[Path] | None = option("A plug-in with an importer; may be repeated.", "--plugin", metavar="FILE"),
    jobs: shared.BackendOptions = shared.BackendOptions(),
    force: bool = shared.FORCE,
    as_json: bool = shared.JSON,
) -> None:
    """Say what is wrong with a recording, and what to type.

    Nothing is changed. Exit 0: ready; 1: fix or record more; 2: the source cannot be read.
    """
    from omnibench.check.check import check_recording
    from omnibench.check.source import read_source
    from omnibench.config import parse_settings
    from omnibench.report.recording.inspection_report import CheckResult

    page.refuse(force=force)
    shared.load_given_plugins([Path("none")], plugin)
    with ProgressDisplay() as watch, jobs.opened(watch):
        read = read_source(source, importer, parse_settings(settings), robot)
        checked = check_recording(read)

    result = CheckResult(checked, read.dataset, read.next_command())
    page.write(result.page, announced=True)
    show(result, as_json)
    if checked.verdict != "ready":
        raise typer.Exit(1)


@recording_app.command()
@shared.grouped
def inspect(
    dataset: list[Path] = shared.DATASETS,
    page: shared.ReportOptions = shared.report_options(
        "Write a page: paths, motions driven, wheel rates, runs step by step."
    ),
    jobs: shared.BackendOptions = shared.BackendOptions(),
    force: bool = shared.FORCE,
    as_json: bool = shared.JSON,
) -> None:
    """Show what a data set holds, and what can be identified from it."""
    from omnibench.report.recording.inspection_report import InspectionResult

    page.refuse(force=force)
    with ProgressDisplay() as watch, jobs.opened(watch):
        recordings = omnibench.load_dataset(dataset)
        inspection = omnibench.inspect_dataset(recordings)
    result = InspectionResult(inspection, recordings, dataset)
    page.write(result.page, announced=True)
    show(result, as_json)


@recording_app.command(cls=shared.ModelCommand)
@shared.grouped
def design(
    source: Path | None = argument(  # noqa: ARG001 (a field of the request)
        "Data set folder, or config of a comparison or a design.", metavar="DATASET|CONFIG"
    ),
    request: "DesignRequest" = options_of("omnibench.design.candidates:DesignRequest"),
    output: Path | None = output_option("Folder for report.html and design.json. Default: nothing is written."),
    figures: Path | None = shared.FIGURES,
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Choose the motion commands that are most worth driving.

    These are the runs from which the matrix would be calibrated most precisely (D-optimal design): of those that were
    recorded or that a config lists, or, with --robot, of lines, arcs and turns that fit robot and room.
    """
    from omnibench.config import to_json
    from omnibench.design.report import DesignResult

    shared.refuse_figures_without_browser(figures)
    if output is not None:
        refuse_existing(output / "design.json", output / "report.html", force=force)
    shared.load_given_plugins(plugins)
    chosen = omnibench.design_experiment(request.candidates(), **request.choices)
    if output is not None:
        write_text(output / "design.json", to_json(chosen) + "\n")
    page = shared.ReportOptions(None if output is None else output / "report.html", figures)
    result = DesignResult(chosen, output)
    page.write(result.page)
    show(result, as_json)


@recording_app.command(cls=shared.ModelCommand)
@shared.grouped
def slam(
    dataset: Path = argument("Data set folder with laser scans.", ...),  # noqa: ARG001 (a field of the request)
    output: Path | None = output_option("Data set folder to write, with the new poses."),
    request: "SlamRequest" = options_of("omnibench.slam.slam_dataset:SlamRequest"),
    page: shared.ReportOptions = shared.report_options("Write a page with figures of scans, paths and wheels."),
    settings: list[str] | None = shared.SETTINGS,  # noqa: ARG001 (a field of the request)
    table_format: shared.TableFormat = shared.TABLE_FORMAT,
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Compute reference poses from the laser scans of a data set.

    Each scan is matched against a map that grows from scan to scan.
    """
    from omnibench.report.recording.section import ReferencePosesResult

    shared.load_given_plugins(plugins)
    page.refuse(force=force)
    if output is None and not page.asked and not as_json:
        raise ConfigError("say where the poses go: -o DATASET; or ask for figures alone: --json, --report FILE.html")
    with ProgressDisplay() as watch:
        result = ReferencePosesResult(request.run(watch, table_format), output, page.report)
        if page.asked:
            watch(Progress("writing the report"))
        page.write(result.page)
    show(result, as_json)


@recording_app.command(cls=shared.ModelCommand)
@shared.grouped
def simulate(
    output: Path = output_option("Data set folder to write.", default=...),
    config: Path | None = argument("Config with a simulated data set."),  # noqa: ARG001 (a field of the request)
    request: "SimulationRequest" = options_of("omnibench.simulate.source:SimulationRequest"),
    table_format: shared.TableFormat = shared.TABLE_FORMAT,
    page: shared.ReportOptions = shared.report_options("Write a page with figures of the recording and the truth."),
    force: bool = shared.FORCE,
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """Simulate recordings of a robot whose true model is known.

    The truth stays out of the data set: it is written to another folder with --truth, or else nowhere.
    """
    from omnibench.report.recording.section import SimulatedResult

    page.refuse(force=force)
    shared.load_given_plugins([*(plugins or []), *request.plugins] or None)
    with ProgressDisplay() as watch:
        made = request.write(table_format, watch)
        shown = made.simulation
        known: dict[str, Any] = {"truth": shown.paths, "plan": shown.plan, "starts": shown.starts} if shown else {}
        truth = None if request.truth is None else request.truth / "truth.yaml"
        files = {"truth": truth, "report": page.report}
        result = SimulatedResult(made.dataset, output, accuracy=made.accuracy, known=known, files=files)
        if page.asked:
            watch(Progress("writing the report"))
        page.write(result.page)
    show(result, as_json)
