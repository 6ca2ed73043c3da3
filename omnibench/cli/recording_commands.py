"""``import``, ``fetch``, ``check``, ``inspect``, ``design``, ``slam`` and ``simulate``: recordings, old and new."""

import shlex
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

import omnibench
from omnibench.cli import options as shared
from omnibench.cli.terminal.console import make_console, print_ending, print_json, say, warn
from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.errors import ConfigError, DataError
from omnibench.files import refuse_existing, resolved, write_text
from omnibench.progress import Progress
from omnibench.words import plural

if TYPE_CHECKING:
    from rich.console import Console

    from omnibench.check.check import CheckReport
    from omnibench.report.blocks import Document


recording_app = typer.Typer()


class HelpOfImporters(TyperCommand):
    """The command ``import``, whose help after the name of a format is that importer's."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Print the importer's help where ``FORMAT --help`` was typed; else as any command."""
        if "--help" in args:
            given, _, _ = self.make_parser(ctx).parse_args(args=[each for each in args if each != "--help"])
            if (name := given.get("importer")) is not None:
                from omnibench.cli.terminal.importer_help import importer_help

                shared.load_given_plugins(_paths(given.get("plugins")), _paths(given.get("plugin_files")))
                typer.echo(importer_help(str(name), ctx.command_path))
                ctx.exit()
        return super().parse_args(ctx, args)


def _paths(given: Any) -> list[Path] | None:
    return [Path(each) for each in given] if isinstance(given, list) else None


@recording_app.command("import", cls=HelpOfImporters)
def import_(
    importer: Annotated[
        str,
        typer.Argument(metavar="FORMAT", help="Format of the recordings; import FORMAT --help shows its options."),
    ],
    source: Annotated[Path | None, typer.Argument(help="File or folder with the recordings.")] = None,
    output: Annotated[Path | None, shared.output_option("Data set folder to write.")] = None,
    settings: shared.Settings = None,
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
    table_format: shared.TableFormat = "parquet",
    force: shared.Force = False,
    plugins: shared.Plugins = None,
    plugin_files: shared.PluginFiles = None,
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
    return print_ending(holds, *_next_step(output, report))


def _next_step(folder: Path, report: "CheckReport | None") -> tuple[Any, ...]:
    """The next step after an import in words, then the words to type."""
    if report is None:
        return "see what they tell", "omnibench", "inspect", folder
    if report.command:
        return "mend what it warns of" if report.verdict == "ready" else "mend it", *shlex.split(report.command)
    if report.verdict == "ready":
        return "calibrate it", "omnibench", "calibrate", folder, "-o", "calibration.yaml"
    return "see what is missing", "omnibench", "check", folder


_NAMES = 12  # columns of the list's names, with the spaces around them


@recording_app.command()
def fetch(
    name: Annotated[
        str | None,
        typer.Argument(help="One of the list that is shown without it, or any OWNER/REPO on GitHub."),
    ] = None,
    output: Annotated[
        Path | None,
        shared.output_option("Data set folder to write; of several data sets, the folder above. Default: data/NAME."),
    ] = None,
    commit: Annotated[
        str | None,
        typer.Option(metavar="SHA", help="Commit to take; HEAD: the newest. Default: the one that was tested."),
    ] = None,
    force: shared.Force = False,
) -> None:
    """Clone a public recording from GitHub and import it.

    Your git clones it into ./clones; a clone that is there is used again. Without NAME: the list of known recordings.
    """
    from omnibench.cli.fetch import RECORDINGS, fetch_recording

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


@recording_app.command()
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
    settings: shared.Settings = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with figures of clocks and findings.")
    ] = None,
    figures: shared.Figures = None,
    plugin: Annotated[
        list[Path] | None, typer.Option("--plugin", metavar="FILE", help="A plug-in with an importer; may be repeated.")
    ] = None,
    backend: shared.BackendName = None,
    workers: shared.Workers = None,
    tls_ca: shared.TlsAuthority = None,
    tls_cert: shared.TlsCertificate = None,
    tls_key: shared.TlsKey = None,
    force: shared.Force = False,
    as_json: shared.Json = False,
) -> None:
    """Say what is wrong with a recording, and what to type.

    Nothing is changed. Exit 0: ready; 1: fix or record more; 2: the source cannot be read.
    """
    from omnibench.check.check import check_recording
    from omnibench.check.source import next_command, read_source
    from omnibench.config import parse_settings

    shared.refuse_report(report, figures, force=force)
    shared.load_given_plugins([Path("none")], plugin)
    tls = shared.tls_files(tls_ca, tls_cert, tls_key)
    with ProgressDisplay() as watch, shared.asked_backend(backend, workers, tls, (), watch):
        read = read_source(source, importer, parse_settings(settings), robot)
        checked = check_recording(read)

    def page() -> "Document":
        from omnibench.report.recording.inspection_report import check_document

        return check_document(read.dataset, checked)

    shared.write_asked_report(page, report, figures, announced=True)
    if as_json:
        print_json(checked.model_dump(mode="json", include={"verdict", "needed", "findings", "command"}))
    else:
        _print_check(make_console(), checked, next_command(read))
    if checked.verdict != "ready":
        raise typer.Exit(1)


_COLOURS = {"error": "red", "warning": "yellow", "note": "cyan"}
_NEEDED = {True: "a calibration is needed", False: "a calibration is hardly needed", None: ""}


def _print_check(console: "Console", checked: "CheckReport", next_step: str) -> None:
    """Print the report; what can be typed is not wrapped, so that it can be copied.

    next_step: the command line for a recording that is ready.
    """
    from rich.text import Text

    colour = {"ready": "bold green", "fix": "bold red", "record more": "bold yellow"}[checked.verdict]
    console.print(Text.assemble((checked.verdict.upper(), colour), f": {checked.sentence}."), soft_wrap=True)
    for finding in checked.findings:
        console.print()
        said = Text.assemble((finding.severity, _COLOURS[finding.severity]), f": {finding.what} [{finding.where}]")
        console.print(said, soft_wrap=True)
        if finding.changes and finding.fix:
            console.out(f"  --set {finding.fix}", highlight=False)
        elif finding.fix:
            console.print(f"  {finding.fix}", soft_wrap=True)
    if checked.gain:
        needed = _NEEDED[checked.needed]
        console.print()
        console.print(f"{needed}: {checked.gain}" if needed else checked.gain, soft_wrap=True)
    console.print()
    if checked.command and checked.verdict == "ready":
        print_ending("nothing stands in the way", "mend what it warns of", *shlex.split(checked.command))
    elif checked.command:
        print_ending("what can be mended is mended by one import", "type", *shlex.split(checked.command))
    elif checked.verdict == "record more":
        print_ending("nothing of this can be typed", "record what is missing, and check again")
    elif checked.verdict == "fix":
        print_ending("no option mends this", "correct what is named above, and check again")
    else:
        words = shlex.split(next_step)
        print_ending("nothing stands in the way", f"{words[1]} it", *words)


@recording_app.command()
def inspect(
    dataset: shared.DatasetFolders,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Write a page: paths, motions driven, wheel rates, runs step by step."),
    ] = None,
    figures: shared.Figures = None,
    backend: shared.BackendName = None,
    workers: shared.Workers = None,
    tls_ca: shared.TlsAuthority = None,
    tls_cert: shared.TlsCertificate = None,
    tls_key: shared.TlsKey = None,
    force: shared.Force = False,
    as_json: shared.Json = False,
) -> None:
    """Show what a data set holds, and what can be identified from it."""
    from omnibench.cli.terminal.inspection_summary import print_inspection
    from omnibench.report.recording.inspection_report import inspection_document

    shared.refuse_report(report, figures, force=force)
    tls = shared.tls_files(tls_ca, tls_cert, tls_key)
    with ProgressDisplay() as watch, shared.asked_backend(backend, workers, tls, (), watch):
        recordings = omnibench.load_dataset(dataset)
        inspection = omnibench.inspect_dataset(recordings)
    shared.write_asked_report(lambda: inspection_document(recordings, inspection), report, figures, announced=True)
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
    dataset: shared.WhichDataset = None,
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
        Path | None, shared.output_option("Folder for report.html and design.json. Default: nothing is written.")
    ] = None,
    figures: shared.Figures = None,
    force: shared.Force = False,
    plugins: shared.Plugins = None,
    as_json: shared.Json = False,
) -> None:
    """Choose the motion commands that are most worth driving.

    These are the runs from which the matrix would be calibrated most precisely (D-optimal design): of those that were
    recorded or that a config lists, or, with --robot, of lines, arcs and turns that fit robot and room.
    """
    from omnibench.cli.terminal.design_summary import print_design
    from omnibench.config import to_json
    from omnibench.design.candidates import RobotOptions, design_source
    from omnibench.design.report import design_document
    from omnibench.report.render import write_document

    shared.refuse_figures_without_browser(figures)
    if output is not None:
        refuse_existing(output / "design.json", output / "report.html", force=force)
    shared.load_given_plugins(plugins)
    limits = RobotOptions(max_speed, max_turn_rate, max_wheel_rate, steering_limit, area, position_noise, heading_noise)
    chosen = omnibench.design_experiment(
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
    shared.write_asked_figures(design_document(chosen), figures)
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
    output: Annotated[Path | None, shared.output_option("Data set folder to write, with the new poses.")] = None,
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
    figures: shared.Figures = None,
    settings: shared.Settings = None,
    table_format: shared.TableFormat = "parquet",
    force: shared.Force = False,
    plugins: shared.Plugins = None,
    as_json: shared.Json = False,
) -> None:
    """Compute reference poses from the laser scans of a data set.

    Each scan is matched against a map that grows from scan to scan.
    """
    from omnibench.cli.terminal.slam_summary import print_slam
    from omnibench.config import parse_settings, validate
    from omnibench.slam.slam_dataset import SlamRequest
    from omnibench.slam.slam_options import SlamOptions

    shared.load_given_plugins(plugins)
    given: dict[str, Any] = {} if start is None else {"start": start}
    given |= {"deskew": False} if no_deskew else {}
    request = SlamRequest(
        dataset, output, validate(SlamOptions, parse_settings(settings) | given, "slam --set"), model, truth, force
    )
    shared.refuse_report(report, figures, force=force)
    if output is None and report is None and figures is None and not as_json:
        raise ConfigError("say where the poses go: -o DATASET; or ask for figures alone: --json, --report FILE.html")
    with ProgressDisplay() as watch:
        result = request.run(watch, table_format)

        def page() -> "Document":
            from omnibench.report.recording.section import recording_document

            watch(Progress("writing the report"))
            return recording_document(result.dataset, truth=result.truth, accuracy=result.summary.accuracy)

        shared.write_asked_report(page, report, figures)
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
    output: Annotated[Path, shared.output_option("Data set folder to write.")],
    config: Annotated[Path | None, typer.Argument(help="Config with a simulated data set.")] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the truth: matrix, effects, true poses. Default: not written."),
    ] = None,
    dataset: shared.WhichDataset = None,
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
    table_format: shared.TableFormat = "parquet",
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with figures of the recording and the truth.")
    ] = None,
    figures: shared.Figures = None,
    force: shared.Force = False,
    plugins: shared.Plugins = None,
) -> None:
    """Simulate recordings of a robot whose true model is known.

    The truth stays out of the data set: it is written to another folder with --truth, or else nowhere.
    """
    from omnibench.simulate.source import SimulationRequest

    hidden = tuple(effects or ())
    request = SimulationRequest(output, config, truth, dataset, hidden, like, model, noise, seed, force)
    shared.refuse_report(report, figures, force=force)
    shared.load_given_plugins([*(plugins or []), *request.plugins] or None)
    with ProgressDisplay() as watch:
        made = request.write(table_format, watch)

        def page() -> "Document":
            from omnibench.report.recording.section import recording_document

            watch(Progress("writing the report"))
            shown = made.simulation
            known: dict[str, Any] = {"truth": shown.paths, "plan": shown.plan, "starts": shown.starts} if shown else {}
            return recording_document(made.dataset, accuracy=made.accuracy, **known)

        shared.write_asked_report(page, report, figures)
    warn(made.dataset.warnings)
    if made.accuracy is not None:
        from omnibench.cli.terminal.slam_summary import print_slam_accuracy  # with the report's tables: slow to import

        print_slam_accuracy(make_console(), made.accuracy)
    if truth is not None:
        typer.echo(f"truth: {truth / 'truth.yaml'}")
    if report is not None:
        typer.echo(f"report: {report}")
    typer.echo(f"{plural(len(made.dataset.trajectories), 'simulated trajectory')}: {output}")
    print_ending(f"{output} is a data set like any other", "see what it tells", "omnibench", "inspect", output)
