"""``list``, ``schema`` and ``plugin``: what configs can name, and how to add to it."""

from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from omnibench.cli.options import Force, Json, Plugins, load_given_plugins
from omnibench.cli.terminal.console import make_console, print_ending, print_json, say
from omnibench.errors import ConfigError
from omnibench.words import plural

if TYPE_CHECKING:
    from pydantic import BaseModel

plugin_app = typer.Typer()
_plugin = typer.Typer(help="Write a new plug-in, or check one.", no_args_is_help=True, rich_markup_mode=None)
plugin_app.add_typer(_plugin, name="plugin")

# Where the config of each command is: module and class.
_CONFIGS = {
    "compare": ("omnibench.compare.config", "CompareConfig"),
    "design": ("omnibench.design.config", "DesignConfig"),
    "live": ("omnibench.live.config", "LiveConfig"),
    "simulate": ("omnibench.simulate.source", "SimulationConfig"),
    "study": ("omnibench.study.config", "StudyConfig"),
}


@plugin_app.command("list")
def list_(plugins: Plugins = None, as_json: Json = False) -> None:
    """List calibrators, costs, effects and importers.

    Each with where it comes from: built in, a plug-in's file, or an installed package.
    """
    from omnibench.cli.terminal.registry_tables import print_registries, registry_document

    failures = load_given_plugins(plugins)
    if as_json:
        return print_json(registry_document(failures))
    print_registries(make_console())
    return print_ending(
        "all of these may be named in configs", "read how to choose", "omnibench", "guide", "calibrators"
    )


@plugin_app.command()
def schema(
    kind: Annotated[
        Literal["compare", "design", "live", "simulate", "study"], typer.Argument(help="Which command's config.")
    ] = "compare",
) -> None:
    """Print the JSON schema of a config, for editors."""
    module, name = _CONFIGS[kind]
    config: type[BaseModel] = getattr(import_module(module), name)
    print_json(config.model_json_schema(by_alias=True))
    print_ending(f"this is the JSON schema of configs for {kind}", "write it to a file and name that in your editor")


@_plugin.command("new")
def plugin_new(
    name: Annotated[str, typer.Argument(help="Name of the plug-in in configs.")],
    kind: Annotated[
        str | None, typer.Option(metavar="KIND", help="calibrator, importer, cost or effect. Default: calibrator.")
    ] = None,
    effect: Annotated[bool, typer.Option("--effect", help="Short for --kind effect.")] = False,
    folder: Annotated[
        Path, typer.Option("--folder", "-o", "--output", metavar="DIR", help="Folder to write to.")
    ] = Path("plugins"),
    force: Force = False,
) -> None:
    """Write a working plug-in and its test."""
    from omnibench.testing.plugin_files import new_plugin

    if effect and kind not in (None, "effect"):
        raise ConfigError(f"--effect and --kind {kind} contradict each other; leave one out")
    for file in new_plugin(name, "effect" if effect else kind or "calibrator", folder, force=force):
        typer.echo(f"written: {file}")
    print_ending(
        f"{name} runs as it is", "change it, then check it", "omnibench", "plugin", "check", f"{folder / name}.py"
    )


@_plugin.command("check")
def plugin_check(
    file: Annotated[Path, typer.Argument(help="Plug-in file.")],
    sample: Annotated[Path | None, typer.Option(help="Sample recordings for an importer to read.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Longest time of the whole check, in s.")] = 600.0,
) -> None:
    """Run the conformance tests on a plug-in.

    The exit code is 1 if a test fails.
    """
    from omnibench.testing.plugin_files import check_plugin_apart

    report = check_plugin_apart(file, sample, seconds)
    for result in report.results:
        message = f": {result.message}" if result.message else ""
        say(f"{result.outcome:7} {result.kind} {result.name}: {result.case}{message}")
    counts = Counter(str(result.outcome) for result in report.results)
    typer.echo(", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    if report.failures:
        print_ending(
            f"{file} failed {plural(len(report.failures), 'test')}", "mend what the lines above say and check again"
        )
        raise typer.Exit(1)
    print_ending(f"{file} passes", "use it where its folder is named", "omnibench", "list", "--plugins", file.parent)
