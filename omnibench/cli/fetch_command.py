"""``fetch``: a public recording, cloned by its GitHub name and imported."""

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated

import typer

from omnibench.cli.options import Force, output_option
from omnibench.cli.terminal.console import make_console, print_ending, say, warn
from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.cli.fetch import Fetched

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
    from omnibench.cli.fetch import fetch_recording
    from omnibench.cli.terminal.progress_display import ProgressDisplay

    if name is None:
        return _list_recordings()
    with ProgressDisplay() as watch:
        fetched = fetch_recording(name, output, commit=commit, force=force, report=watch)
    for folder, dataset in fetched.datasets.items():
        warn(f"{folder}: {each}" if len(fetched.datasets) > 1 else each for each in dataset.warnings)
    for folder, dataset in fetched.datasets.items():
        typer.echo(f"{plural(len(dataset.trajectories), 'trajectory')}: {folder}")
    say(f"source: {fetched.source}, in {fetched.clone.folder}")
    say(f"licence: {_licence(fetched)}")
    say(f"cite: {fetched.cite}")
    return _say_what_next(fetched)


def _licence(fetched: "Fetched") -> str:
    """The licence in words, with the file that holds its text."""
    if fetched.licence_file is None:
        return fetched.licence or "the repository states none; ask its authors before you use it"
    folder = next(iter(fetched.datasets), fetched.clone.folder)
    return f"{fetched.licence or 'see'} ({folder / fetched.licence_file.name})"


def _say_what_next(fetched: "Fetched") -> None:
    """The last sentence: what there is now, and what to type."""
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


def _list_recordings() -> None:
    """Every data set of the catalogue, with its robot, its runs and its licence."""
    from omnibench.cli.fetch import RECORDINGS

    width = make_console().width
    for recording in RECORDINGS:
        typer.echo(f"{recording.repository} ({recording.licence}); reference: {recording.reference}")
        for dataset in recording.datasets:
            text = f"{dataset.robot}: {dataset.runs}"
            typer.echo(fill(text, width, initial_indent=f"  {dataset.name:10}", subsequent_indent=" " * _NAMES))
    print_ending("these are the public recordings that are known", "fetch one", "omnibench", "fetch", "omni3")
