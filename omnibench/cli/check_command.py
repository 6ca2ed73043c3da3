"""``check``: is a recording fit for calibration, what is wrong with it, and what to type."""

from pathlib import Path
from typing import Annotated

import typer

from omnibench.cli.options import (
    BackendName,
    Figures,
    Force,
    Json,
    Settings,
    TlsAuthority,
    TlsCertificate,
    TlsKey,
    Workers,
    asked_backend,
    refuse_figures_without_browser,
    tls_files,
    write_asked_figures,
)

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
    from omnibench.cli.terminal.check_summary import print_check
    from omnibench.cli.terminal.console import make_console, print_json
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
        from omnibench.report.recording.check_document import check_document
        from omnibench.report.render import write_document

        document = check_document(read.dataset, checked)
        if report is not None:
            write_document(document, report)
            typer.echo(f"report: {report}", err=True)
        write_asked_figures(document, figures)
    if as_json:
        print_json(checked.model_dump(mode="json", include={"verdict", "needed", "findings"}))
        return
    print_check(make_console(), checked, next_command(read))
