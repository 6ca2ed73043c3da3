"""``discover``: what the model lacks."""

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnibench.cli.options import Json, Plugins, load_given_plugins
from omnibench.cli.terminal.console import make_console, print_json, warn

if TYPE_CHECKING:
    pass

discovery_app = typer.Typer()


@discovery_app.command()
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
    from omnibench.cli.terminal.discovery_summary import print_discovery
    from omnibench.cli.terminal.progress import Stages
    from omnibench.data.storage import load_dataset
    from omnibench.discover.discover import discover_effects
    from omnibench.discover.document import discovery_document
    from omnibench.discover.output import DiscoverOptions, check_output, write_discovery
    from omnibench.registry import effects
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    for name in without or ():
        effects.entry(name, "--without")
    check_output(output)
    start = None if model is None else read_calibration(model)
    recordings = load_dataset(dataset)
    with redirect_stdout(sys.stderr), Stages(make_console(error=True)) as watch:
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
    warn(recordings.warnings)
    if as_json:
        return print_json(discovery_document(found, folder))
    return print_discovery(make_console(), found, folder)
