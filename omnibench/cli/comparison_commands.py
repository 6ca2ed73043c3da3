"""``compare``: several calibrators on equal terms."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnibench.cli.options import (
    BackendName,
    Figures,
    Force,
    TlsAuthority,
    TlsCertificate,
    TlsKey,
    output_option,
    plugin_folders,
    refuse_figures_without_browser,
    tls_files,
    write_asked_figures,
)
from omnibench.cli.terminal.console import make_console, print_ending, print_verdict, warn
from omnibench.errors import ConfigError, DataError

if TYPE_CHECKING:
    from omnibench.compare.config import CompareConfig

comparison_app = typer.Typer()


@comparison_app.command()
def compare(
    config: Annotated[
        list[Path],
        typer.Argument(
            metavar="CONFIG|DATASET",
            help="Comparison config (YAML), or a data set (its folder, several, a glob) for a quick comparison.",
        ),
    ],
    output: Annotated[
        Path | None,
        output_option("Folder for the results; finished runs in it are kept. Default: results/NAME/TIME."),
    ] = None,
    data: Annotated[
        list[str] | None,
        typer.Option(
            "--data",
            metavar="[NAME=]PATH",
            help="Where the recordings of the config's data set NAME are on this disk; of a study, the folder of all.",
        ),
    ] = None,
    backend: BackendName = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes, or Dask workers started here. Default: the config's.")
    ] = None,
    tls_ca: TlsAuthority = None,
    tls_cert: TlsCertificate = None,
    tls_key: TlsKey = None,
    figures: Figures = None,
    force: Force = False,
    plugins: Annotated[
        list[Path] | None,
        typer.Option("--plugins", metavar="DIR", help="Folder of plug-ins besides the config's; may be repeated."),
    ] = None,
) -> None:
    """Run calibrators on equal terms, score them, write a report.

    All calibrators of the config, or all that suit the data set, get the same data and the same budget. A config that
    names robots is a study: every method on several robots and kinds of path. Run again with the same -o, it goes on
    where it was stopped.
    """
    from omnibench.cli.terminal.comparison_tables import print_comparison_ending, print_result
    from omnibench.cli.terminal.progress_display import ProgressDisplay
    from omnibench.compare.report.comparison_report import comparison_document
    from omnibench.compare.run import run_comparison
    from omnibench.progress import Progress

    refuse_figures_without_browser(figures)
    asked = plugin_folders(plugins or [])
    given = {"backend": backend, "workers": workers, "tls": tls_files(tls_ca, tls_cert, tls_key)}
    given = {name: value for name, value in given.items() if value is not None}
    from omnibench.study.study import is_study, read_study_config, run_study

    if len(config) == 1 and config[0].is_file() and is_study(config[0]):
        # The exit code is 1 if a recording of a study cannot be read, or no method answered.
        from omnibench.cli.terminal.comparison_tables import print_study, print_study_ending
        from omnibench.study.report.study_report import study_document

        study = read_study_config(config[0], _named_paths(data))
        folders = [*study.plugins, *(folder.resolve() for folder in asked)]
        study = study.model_copy(update={"plugins": tuple(dict.fromkeys(folders))} | given)
        with ProgressDisplay() as watch:
            answer = run_study(study, output, watch, force=force)
            if figures is not None:
                watch(Progress("drawing the figures"))
                write_asked_figures(study_document(answer), figures)
        warn(answer.warnings)
        print_study(make_console(), answer)
        typer.echo(f"report: {answer.output / 'report.html'}")
        if not print_study_ending(answer):
            raise typer.Exit(1)
        return None
    comparison = _asked_comparison(config, data, asked)
    folders = [*comparison.plugins, *(folder.resolve() for folder in asked)]
    comparison = comparison.model_copy(update={"plugins": tuple(dict.fromkeys(folders))} | given)
    with ProgressDisplay() as watch:
        result = run_comparison(comparison, output, watch, force=force)
        if figures is not None:
            watch(Progress("drawing the figures"))
            write_asked_figures(comparison_document(result), figures)
    warn(result.warnings)
    print_result(make_console(), result)
    for name, entry in result.held_out.items():
        print_verdict(entry.verdict, f"{name}, {entry.label}: ", result.sessions.get(name, ()))
    typer.echo(f"report: {result.output / 'report.html'}")
    if result.every_search_failed:
        print_ending(
            f"every search failed, the first: {result.failures[0]}", "mend what its reason names, and run again"
        )
        raise typer.Exit(1)
    return print_comparison_ending(result)


def _asked_comparison(given: Sequence[Path], data: list[str] | None, plugins: Sequence[Path]) -> "CompareConfig":
    """The config that is given, or one for the data set that is: its folders, or a glob."""
    from omnibench.compare.config import read_compare_config
    from omnibench.compare.recording_config import config_in_words, recording_config
    from omnibench.data.tables import is_glob

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
        return read_compare_config(first, _named_paths(data))
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
