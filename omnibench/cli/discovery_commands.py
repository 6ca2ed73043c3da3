"""``discover``: what the odometry model lacks."""

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

import typer

from omnibench.cli.options import (
    DatasetFolder,
    Figures,
    Force,
    Json,
    Plugins,
    load_given_plugins,
    output_option,
    refuse_figures_without_browser,
    write_asked_figures,
)
from omnibench.cli.terminal.console import make_console, print_json, warn

discovery_app = typer.Typer()


@discovery_app.command()
def discover(
    dataset: DatasetFolder,
    model: Annotated[
        Path | None,
        typer.Option("--model", metavar="CALIBRATION", help="Start from this calibration. Default: fit a matrix."),
    ] = None,
    output: Annotated[Path | None, output_option("Folder for the results. Default: results/NAME/TIME.")] = None,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="NAME", help="Effect not to try; may be repeated.")
    ] = None,
    unknown_term: Annotated[
        bool,
        typer.Option(help="Where no name is sure, close the gap all the same, by a term without a name."),
    ] = True,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
    figures: Figures = None,
    force: Force = False,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Find and name the physics that a robot's model lacks.

    Shows where odometry and reference disagree, names the effect that explains it, adds it to the calibration, and
    tells how much smaller the error becomes on runs that were held out.
    """
    from omnibench.cli.terminal.discovery_summary import print_discovery
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.config import to_yaml
    from omnibench.data.storage import load_whole
    from omnibench.discover.discover import discover_effects
    from omnibench.discover.output import DiscoverOptions, check_output, write_discovery
    from omnibench.discover.report.discovery_report import discovery_report
    from omnibench.discover.result import discovery_document
    from omnibench.progress import Progress
    from omnibench.registry import effects
    from omnibench.robot.calibration import read_calibration

    refuse_figures_without_browser(figures)
    load_given_plugins(plugins)
    for name in without or ():
        effects.entry(name, "--without")
    options = DiscoverOptions(
        dataset=str(dataset),
        model=None if model is None else str(model),
        without=tuple(without or ()),
        unknown_term=unknown_term,
        seed=seed,
        plugins=tuple(map(str, plugins or ())),
    )
    check_output(output, options, force=force)
    start = None if model is None else read_calibration(model)
    recordings = load_whole(dataset)
    with redirect_stdout(sys.stderr), ProgressDisplay() as watch:
        discovery = discover_effects(
            recordings,
            without=tuple(without or ()),
            unknown_term=unknown_term,
            seed=seed,
            watch=watch,
            calibration=start,
        )
        watch(Progress("writing the report"))
        folder = write_discovery(discovery, options, output, force=force)
        if figures is not None:
            write_asked_figures(discovery_report(discovery, to_yaml(options)), figures)
    warn(recordings.warnings)
    if as_json:
        return print_json(discovery_document(discovery, folder))
    return print_discovery(make_console(), discovery, folder)
