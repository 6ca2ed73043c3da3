"""``import``, ``check`` and ``fetch``: from a recording, or a public one's name, to a checked data set."""

import shlex
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from omnibench.cli.options import (
    BackendName,
    Figures,
    Force,
    Json,
    PluginFiles,
    Plugins,
    Settings,
    TableFormat,
    TlsAuthority,
    TlsCertificate,
    TlsKey,
    Workers,
    asked_backend,
    load_given_plugins,
    output_option,
    refuse_figures_without_browser,
    tls_files,
    write_asked_figures,
)
from omnibench.cli.terminal.console import make_console, print_ending, print_json, say, warn
from omnibench.errors import ConfigError, DataError
from omnibench.words import plural

if TYPE_CHECKING:
    from rich.console import Console

    from omnibench.fit.check.checking import CheckReport
    from omnibench.fit.check.fixes import RecordingSource


import_app = typer.Typer()


class HelpOfImporters(TyperCommand):
    """The command ``import``, whose help after the name of a format is that importer's."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Print the importer's help where ``FORMAT --help`` was typed; else as any command."""
        if "--help" in args:
            given, _, _ = self.make_parser(ctx).parse_args(args=[each for each in args if each != "--help"])
            if (name := given.get("importer")) is not None:
                from omnibench.cli.terminal.importer_help import importer_help

                load_given_plugins(_paths(given.get("plugins")), _paths(given.get("plugin_files")))
                typer.echo(importer_help(str(name), ctx.command_path))
                ctx.exit()
        return super().parse_args(ctx, args)


def _paths(given: Any) -> list[Path] | None:
    return [Path(each) for each in given] if isinstance(given, list) else None


@import_app.command("import", cls=HelpOfImporters)
def import_(
    importer: Annotated[
        str,
        typer.Argument(metavar="FORMAT", help="Format of the recordings; import FORMAT --help shows its options."),
    ],
    source: Annotated[Path | None, typer.Argument(help="File or folder with the recordings.")] = None,
    output: Annotated[Path | None, output_option("Data set folder to write.")] = None,
    settings: Settings = None,
    accept_units: Annotated[
        bool, typer.Option("--accept-units", help="Write the data set even if units look wrong by magnitude.")
    ] = False,
    template: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="csv, without SOURCE: write tables and robot.yaml to fill in."),
    ] = None,
    robot_type: Annotated[
        Literal["diff", "omni3", "mecanum", "tricycle", "car", "swerve", "skid"] | None,
        typer.Option(help="With --template: the robot's type. Default: diff."),
    ] = None,
    references: Annotated[
        bool,
        typer.Option(
            "--references", help="With --template: distances and turned angles, measured by hand, instead of poses."
        ),
    ] = False,
    no_check: Annotated[bool, typer.Option("--no-check", help="Leave out the check of what was recorded.")] = False,
    table_format: TableFormat = "parquet",
    force: Force = False,
    plugins: Plugins = None,
    plugin_files: PluginFiles = None,
) -> None:
    """Convert recordings into a data set.

    omnibench import FORMAT --help lists the options of a format, which --set takes. Formats: csv (tables of any
    robot), rosbag, dataset (a data set again, with other options), table1, optiodom and plug-ins. Recordings with laser
    scans but without reference poses get these by SLAM.
    """
    from omnibench.config import parse_settings
    from omnibench.data.checks.finding import UNITS, FindingWarning
    from omnibench.data.dataset import Imported
    from omnibench.data.splits import division_in_words
    from omnibench.data.storage import check_dataset_folder, save_dataset
    from omnibench.files import refuse_existing, resolved
    from omnibench.fit.check.fixes import RecordingSource
    from omnibench.registry import importers
    from omnibench.slam.import_dataset import import_dataset

    load_given_plugins(plugins, plugin_files)
    entry, given = importers.entry(importer, "import"), parse_settings(settings)
    if template is not None:
        # Write tables and robot.yaml to fill in, and say what to type then.
        from omnibench.data.importers.csv_tables.csv_template import write_template

        if importer != "csv":
            raise ConfigError(f"--template is for csv, not for {importer}: omnibench import csv --template {template}")
        if source is not None or output is not None:
            raise ConfigError("--template DIR writes tables to fill in; leave SOURCE and -o out")
        refuse_existing(template, force=force, folders=True)
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
    dataset = import_dataset(importer, source, options)
    read = RecordingSource(dataset, importer, source, given, output)
    report = None if no_check else _checked(read)
    if not accept_units:
        # Units that cannot be right are refused, with what to type.
        wrong: list[str] = [each for each in dataset.warnings if isinstance(each, FindingWarning) and each.unit]
        if not wrong and report is not None:
            wrong = [each.what for each in report.findings if each.kind in UNITS and each.severity == "error"]
        if wrong:
            mended = (report or _checked(read)).command
            way = f"type {mended}, or " if mended else ""
            raise DataError(f"{'; '.join(wrong)}; {output} is not written: {way}--accept-units to write it as it is")
    dataset = replace(dataset, imported=Imported.of(importer, source, given))
    save_dataset(dataset, output, table_format, overwrite=force)
    said = "" if report is None else report.sentence  # the findings that the check's sentence names
    warn([each for each in dataset.warnings if not (isinstance(each, FindingWarning) and each.finding.what in said)])
    typer.echo(f"{plural(len(dataset.trajectories), 'trajectory')}: {output}")
    way = " (other: --set validation=PATTERN)" if "validation" in entry.cls.Options.model_fields else ""
    divided = f"{division_in_words(dataset.trajectories, options)}{way}"
    make_console(error=True).print(divided, soft_wrap=True)
    then: tuple[str, tuple[object, ...]] = ("see what they tell", ("omnibench", "inspect", output))
    if report is not None:
        from omnibench.fit.check.checking import mending

        make_console(error=True).print(f"check: {report.sentence}.", soft_wrap=True)
        then = "see what is missing", ("omnibench", "check", output)
        if typed := mending(read, report):
            then = "mend it", tuple(shlex.split(typed))
        elif report.verdict == "ready":
            then = "calibrate it", ("omnibench", "calibrate", output, "-o", "calibration.yaml")
    holds = f"{output} holds {plural(len(dataset.trajectories), 'run')} of {dataset.robot.name}"
    return print_ending(holds, then[0], *then[1])


def _checked(read: "RecordingSource") -> "CheckReport":
    from omnibench.fit.check.checking import check_recording  # slow to import, and left out by --no-check

    return check_recording(read)


check_app = typer.Typer()


@check_app.command()
def check(
    source: Annotated[
        list[Path],
        typer.Argument(
            help="Data set folder, or several; folder or file of CSV tables, or a bag.", metavar="SOURCE..."
        ),
    ],
    importer: Annotated[
        str | None,
        typer.Option("--format", metavar="NAME", help="Importer of the source. Default: by its files."),
    ] = None,
    robot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="robot.yaml, where the source does not say the robot.")
    ] = None,
    settings: Settings = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with figures of clocks and findings.")
    ] = None,
    figures: Figures = None,
    plugin: Annotated[
        list[Path] | None, typer.Option("--plugin", metavar="FILE", help="A plug-in with an importer; may be repeated.")
    ] = None,
    backend: BackendName = None,
    workers: Workers = None,
    tls_ca: TlsAuthority = None,
    tls_cert: TlsCertificate = None,
    tls_key: TlsKey = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Say what is wrong with a recording, and what to type.

    Nothing is changed. Exit 0 whatever the verdict; 2 where the source cannot be read.
    """

    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.config import parse_settings
    from omnibench.errors import PluginError
    from omnibench.files import refuse_existing
    from omnibench.fit.check.checking import check_recording
    from omnibench.fit.check.fixes import next_command, read_source
    from omnibench.registry import load_plugin_file, load_plugins

    refuse_existing(report, force=force)
    refuse_figures_without_browser(figures)
    load_plugins()
    for file in plugin or ():
        if (failure := load_plugin_file(file)) is not None:
            raise PluginError(f"plug-in {failure.origin} cannot be imported: {failure.error}")
    tls = tls_files(tls_ca, tls_cert, tls_key)
    with ProgressDisplay() as watch, asked_backend(backend, workers, tls, (), watch):
        read = read_source(source, importer, parse_settings(settings), robot)
        checked = check_recording(read)
    if report is not None or figures is not None:
        from omnibench.report.recording.inspection_report import check_document
        from omnibench.report.render import write_document

        document = check_document(read.dataset, checked)
        if report is not None:
            write_document(document, report)
            typer.echo(f"report: {report}", err=True)
        write_asked_figures(document, figures)
    if as_json:
        print_json(checked.model_dump(mode="json", include={"verdict", "needed", "findings"}))
        return
    _print_check(make_console(), checked, next_command(read))


_NEEDED = {True: "a calibration is needed", False: "a calibration is hardly needed", None: ""}


def _print_check(console: "Console", checked: "CheckReport", then: str) -> None:
    """Print the report; what can be typed is not wrapped, so that it can be copied.

    then: the command line for a recording that is ready.
    """
    console.print(f"{checked.verdict.upper()}: {checked.sentence}.", soft_wrap=True)
    for finding in checked.findings:
        console.print()
        console.print(f"{finding.severity}: {finding.what} [{finding.where}]", soft_wrap=True)
        if finding.fix.startswith("omnibench "):
            console.out(f"  {finding.fix}", highlight=False)
        elif finding.fix:
            console.print(f"  {finding.fix}", soft_wrap=True)
    if checked.gain:
        needed = _NEEDED[checked.needed]
        console.print()
        console.print(f"{needed}: {checked.gain}" if needed else checked.gain, soft_wrap=True)
    console.print()
    if checked.command:
        print_ending("what can be mended is mended by one import", "type", *shlex.split(checked.command))
    elif checked.verdict == "record more":
        print_ending("nothing of this can be typed", "record what is missing, and check again")
    else:
        words = shlex.split(then)
        print_ending("nothing stands in the way", f"{words[1]} it", *words)


fetch_app = typer.Typer()

_NAMES = 12  # columns of the list's names, with the spaces around them


@fetch_app.command()
def fetch(
    name: Annotated[
        str | None,
        typer.Argument(help="One of the list that is shown without it, or any OWNER/REPO on GitHub."),
    ] = None,
    output: Annotated[
        Path | None,
        output_option("Data set folder to write; of several data sets, the folder above. Default: data/NAME."),
    ] = None,
    commit: Annotated[
        str | None,
        typer.Option(metavar="SHA", help="Commit to take; HEAD: the newest. Default: the one that was tested."),
    ] = None,
    force: Force = False,
) -> None:
    """Clone a public recording from GitHub and import it.

    Your git clones it into ./clones; a clone that is there is used again. Without NAME: the list of known recordings.
    """
    from omnibench.cli.fetch import RECORDINGS, fetch_recording
    from omnibench.cli.terminal.progress_display import ProgressDisplay

    if name is None:
        width = make_console().width
        for recording in RECORDINGS:
            typer.echo(f"{recording.repository} ({recording.licence}); reference: {recording.reference}")
            for listed in recording.datasets:
                text = f"{listed.robot}: {listed.runs}"
                typer.echo(fill(text, width, initial_indent=f"  {listed.name:10}", subsequent_indent=" " * _NAMES))
        print_ending("these are the public recordings that are known", "fetch one", "omnibench", "fetch", "omni3")
        return None
    with ProgressDisplay() as watch:
        fetched = fetch_recording(name, output, commit=commit, force=force, report=watch)
    for folder, dataset in fetched.datasets.items():
        warn(f"{folder}: {each}" if len(fetched.datasets) > 1 else each for each in dataset.warnings)
    for folder, dataset in fetched.datasets.items():
        typer.echo(f"{plural(len(dataset.trajectories), 'trajectory')}: {folder}")
    say(f"source: {fetched.source}, in {fetched.clone.folder}")
    licence = fetched.licence or "the repository states none; ask its authors before you use it"
    if fetched.licence_file is not None:
        place = next(iter(fetched.datasets), fetched.clone.folder) / fetched.licence_file.name
        licence = f"{fetched.licence or 'see'} ({place})"
    say(f"licence: {licence}")
    say(f"cite: {fetched.cite}")
    # What there is now, and what to type.
    clone = fetched.clone
    if fetched.datasets:
        folder, dataset = next(iter(fetched.datasets.items()))
        count = plural(len(dataset.trajectories), "run")
        rest = f" and {plural(len(fetched.datasets) - 1, 'more folder')}" if len(fetched.datasets) > 1 else ""
        holds = f"{folder} holds {count} of {dataset.robot.name}" if not rest else f"{folder}{rest} hold the recordings"
        return print_ending(holds, "see whether they are fit for calibration", "omnibench", "check", folder)
    make_console(error=True).print(f"not imported: {fetched.refusal}", soft_wrap=True)
    if not fetched.importer:
        return print_ending(f"{clone.folder} holds {clone.repository}", "see what can be imported", "omnibench", "list")
    command = ("omnibench", "import", fetched.importer, "--help")
    return print_ending(f"{clone.folder} holds {clone.repository}", "see what its import needs", *command)
