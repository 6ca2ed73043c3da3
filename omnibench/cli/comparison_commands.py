"""``compare``: several calibrators on equal terms."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnibench.cli.terminal.console import make_console, warn
from omnibench.errors import ConfigError

if TYPE_CHECKING:
    pass

comparison_app = typer.Typer()


@comparison_app.command()
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
    from omnibench.cli.terminal.comparison_tables import print_result
    from omnibench.cli.terminal.progress import Bars, Lines
    from omnibench.compare.read_config import read_compare_config
    from omnibench.compare.run import run_comparison

    chosen = read_compare_config(config, _named_paths(data))
    folders = [*chosen.plugins, *(folder.resolve() for folder in plugins or [])]
    chosen = chosen.model_copy(update={"plugins": tuple(dict.fromkeys(folders))})
    console = make_console(error=True)
    watch: Bars | Lines = Bars(console) if console.is_terminal else Lines(console)
    with watch:
        result = run_comparison(chosen, output, watch)
    warn(result.warnings)
    out = make_console()
    print_result(out, result)
    out.print(f"report: {result.output / 'report.html'}", highlight=False, soft_wrap=True)
    if all(run.matrix is None for run in result.runs):
        raise typer.Exit(1)


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
