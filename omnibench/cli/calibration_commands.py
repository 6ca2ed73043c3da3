"""``calibrate``, ``evaluate``, ``certify`` and ``export``: one calibration, from its fit to its use elsewhere."""

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated, Literal

import typer

from omnibench.cli.options import (
    BackendName,
    CalibrationFile,
    DatasetFolders,
    FitCommand,
    Force,
    Json,
    Plugins,
    Settings,
    TlsAuthority,
    TlsCertificate,
    TlsKey,
    Workers,
    asked_backend,
    chosen_settings,
    load_given_plugins,
    output_option,
    tls_files,
)
from omnibench.cli.terminal.console import make_console, print_ending, print_json, print_verdict, warn

calibration_app = typer.Typer()


@calibration_app.command(cls=FitCommand)
def calibrate(
    context: typer.Context,
    dataset: DatasetFolders,
    output: Annotated[
        Path | None, output_option("Calibration file to write. Default: it is only shown.", metavar="FILE.yaml")
    ] = None,
    backend: BackendName = None,
    workers: Workers = None,
    tls_ca: TlsAuthority = None,
    tls_cert: TlsCertificate = None,
    tls_key: TlsKey = None,
    settings: Settings = None,
    force: Force = False,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Fit a robot's odometry model; write it with -o.

    The fit uses the training split of the data set, and never its validation split.
    """
    from omnibench.cli.terminal.calibration_tables import print_calibration, print_verdict_ending
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.config import parse_settings, to_yaml
    from omnibench.data.storage import load_dataset
    from omnibench.files import refuse_existing, write_text
    from omnibench.fit.calibrate import calibrate as fit

    load_given_plugins(plugins)
    chosen = chosen_settings(context, parse_settings(settings))
    refuse_existing(output, force=force)
    tls, preload = tls_files(tls_ca, tls_cert, tls_key), ("omnibench.fit.bootstrap",)
    with (
        redirect_stdout(sys.stderr),
        ProgressDisplay() as watch,
        asked_backend(backend, workers, tls, preload, watch) as jobs,
    ):
        recordings = load_dataset(dataset)
        run = fit(recordings, chosen, watch=watch, backend=jobs)
    calibration, result = run.calibration, run.result
    if output is not None:
        write_text(output, to_yaml(calibration))
    warn([*recordings.warnings, *run.warnings])
    if result.at_bounds:
        when = "" if result.shrinkage is None else " before the answer was shrunk to the design"
        warn([f"on a bound of the box {chosen.box!r}{when}: {', '.join(result.at_bounds)}; a wider box may fit better"])
    if run.untouched:
        warn([f"not fitted, kept at the start value by the box {chosen.box!r} or the cost: {', '.join(run.untouched)}"])
    if as_json:
        return print_json(calibration)
    print_calibration(make_console(), run)
    if output is not None:
        typer.echo(f"calibration: {output}")
    assert calibration.provenance is not None  # a fit has one, with its verdict
    assert calibration.provenance.held_out is not None
    print_verdict(calibration.provenance.held_out)
    if output is None:
        again = ("omnibench", *sys.argv[1:], "-o", "calibration.yaml")
        return print_ending("the calibration above is written nowhere", "write it to a file", *again)
    return print_verdict_ending(calibration.provenance.held_out, calibration, output, dataset)


@calibration_app.command()
def evaluate(
    calibration: CalibrationFile,
    dataset: DatasetFolders,
    backend: BackendName = None,
    workers: Workers = None,
    tls_ca: TlsAuthority = None,
    tls_cert: TlsCertificate = None,
    tls_key: TlsKey = None,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Show the cost and the errors of a calibration on a data set.

    On each split: the cost, and the errors of the final pose, beside those of the robot's design values.
    """
    from omnibench.cli.terminal.calibration_tables import print_evaluation, print_verdict_ending
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.data.storage import load_dataset
    from omnibench.fit.evaluate import evaluate as evaluate_calibration
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    tls = tls_files(tls_ca, tls_cert, tls_key)
    with ProgressDisplay() as watch, asked_backend(backend, workers, tls, (), watch):
        recordings = load_dataset(dataset)
        evaluated = read_calibration(calibration)
        evaluation = evaluate_calibration(evaluated, recordings)
    warnings = [*recordings.warnings, *evaluation.warnings]
    warn(warnings)
    if as_json:
        return print_json(evaluation.model_dump() | {"warnings": warnings})
    print_evaluation(make_console(), evaluation)
    print_verdict(evaluation.held_out, sessions=evaluation.sessions)
    return print_verdict_ending(evaluation.held_out, evaluated, calibration, dataset)


@calibration_app.command()
def certify(
    calibration: CalibrationFile,
    dataset: DatasetFolders,
    box: Annotated[
        Literal["paper", "row"] | None,
        typer.Option(help="Matrices to compare with; see calibrate. Default: the box of the calibration's search."),
    ] = None,
    gap: Annotated[
        float, typer.Option(min=1e-9, max=0.999, help="Stop once at most this share of the cost could be saved.")
    ] = 1e-3,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Stop after this time, in s; the bound proven by then holds.")
    ] = 60.0,
    parts: Annotated[
        int | None, typer.Option(min=1, help="Stop after so many parts of the box: a limit that no machine changes.")
    ] = None,
    backend: BackendName = None,
    workers: Workers = None,
    tls_ca: TlsAuthority = None,
    tls_cert: TlsCertificate = None,
    tls_key: TlsKey = None,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Prove how far a calibration's cost is from the lowest possible.

    Gives a lower bound on the cost of every matrix in the box, on the training split, whatever the optimiser.
    """
    from omnibench.cli.terminal.calibration_tables import print_certificate, print_certificate_ending
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.data.storage import load_dataset
    from omnibench.fit.certify import certify_optimum
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    tls, preload = tls_files(tls_ca, tls_cert, tls_key), ("omnibench.fit.certify",)
    with ProgressDisplay() as watch, asked_backend(backend, workers, tls, preload, watch) as jobs:
        recordings = load_dataset(dataset)
        certified = certify_optimum(
            read_calibration(calibration),
            recordings,
            box=box,
            gap=gap,
            seconds=seconds,
            parts=parts,
            watch=watch,
            backend=jobs,
        )
    warn(recordings.warnings)
    if not certified.inside:
        warn([f"the calibration is outside the box {certified.certificate.box!r}; the bound is for matrices inside it"])
    if as_json:
        return print_json(certified.certificate.model_dump(exclude_none=True))
    print_certificate(make_console(), certified)
    return print_certificate_ending(certified, calibration, dataset)


@calibration_app.command()
def export(
    calibration: CalibrationFile,
    to: Annotated[
        str, typer.Option("--to", metavar="FORMAT", help="ros2_controllers, robot_localization or c_header.")
    ],
    output: Annotated[Path | None, output_option("File or folder to write to. Default: standard output.")] = None,
    force: Force = False,
    plugins: Plugins = None,
) -> None:
    """Convert a calibration for ROS 2 or C programs.

    ros2_controllers takes the controller of the robot's kind, and says what it cannot hold of the calibration.
    """
    from omnibench.errors import visible
    from omnibench.files import refuse_existing, write_text
    from omnibench.robot.calibration import read_calibration
    from omnibench.robot.export.formats import export_calibration

    load_given_plugins(plugins)
    exported = export_calibration(read_calibration(calibration), to)
    file = output / exported.file_name if output is not None and output.is_dir() else output
    refuse_existing(file, force=force)
    warn(exported.warnings)
    if file is None:
        typer.echo(visible(exported.text), nl=False)
        print_ending(f"{to}: printed, not written", "write it to a file with -o FILE")
    else:
        write_text(file, exported.text)
        print_ending(f"{file} is written for {to}", "load it where the robot's odometry is computed")
