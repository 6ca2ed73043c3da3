"""The commands for whoever begins or extends: the handbook, examples to run, and plug-ins."""

import shlex
import sys
from collections import Counter
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from omnibench.cli import options as shared
from omnibench.cli.options import argument, flag, names_in, option, output_option
from omnibench.cli.terminal.console import make_console, print_ending, print_json, print_names, say
from omnibench.errors import ConfigError
from omnibench.files import resolved
from omnibench.words import plural

if TYPE_CHECKING:
    from pydantic import BaseModel


guide_app = typer.Typer()

_READING_WIDTH = 100  # columns: longer lines are hard to follow
_NAME_WIDTH = 17  # columns, of the longest topic and two spaces
_MOST_LISTED = 10  # files of a folder that are written out by name


@guide_app.command()
def guide(
    topic: str | None = argument(
        "What to read about. Default: the list of topics.",
        autocompletion=names_in("omnibench.cli.handbook_topics:topics"),
    ),
) -> None:
    """Show the handbook: a topic, or the list of topics."""
    from omnibench.cli.handbook_topics import find_topic, topics

    if topic is None:
        listed = topics()
        for group in dict.fromkeys(topic.group for topic in listed):
            typer.echo(f"{group}:")
            print_names({topic.name: topic.summary for topic in listed if topic.group == group}, _NAME_WIDTH)
        print_ending("these are the pages of the handbook", "read one", "omnibench", "guide", "getting-started")
    else:
        # As pages on a terminal, as it stands where it is piped.
        markdown = find_topic(topic).text
        if sys.stdout.isatty():
            from rich.console import Console
            from rich.markdown import Markdown
            from rich.theme import Theme

            console = Console(theme=Theme({"markdown.code": "bold cyan"}), emoji=False)
            console.width = min(console.width, _READING_WIDTH)
            console.print(Markdown(markdown, code_theme="ansi_dark"))
        else:
            typer.echo(markdown, nl=False)
        print_ending(f"this was the page {topic!r}", "see what else there is to read", "omnibench", "guide")


@guide_app.command()
def example(
    name: str | None = argument(
        "One of the list that is shown without it.", autocompletion=names_in("omnibench.cli.examples:EXAMPLES")
    ),
    output: Path | None = output_option("Folder to write to.", metavar="DIR"),
    force: bool = shared.FORCE,
) -> None:
    """Write an example to begin with, or list the examples.

    An example is a config with all that it needs, or a small recording.
    """
    from omnibench.cli.examples import EXAMPLES, find_example, write_example

    if name is None:
        print_names({each.name: each.summary for each in EXAMPLES}, _NAME_WIDTH)
        print_ending("these are the examples", "write one into a folder", "omnibench", "example", "small", "-o", "demo")
        return None
    chosen = find_example(name)
    if output is None:
        raise ConfigError(f"say where the example goes: omnibench example {name} -o DIR")
    written = write_example(chosen, output, force=force)
    # A line for each file, and one for a folder of many.
    for folder, group in groupby(written, lambda file: file.parent):
        listed = list(group)
        if len(listed) > _MOST_LISTED:
            typer.echo(f"written: {folder} ({plural(len(listed), 'file')})")
        else:
            for file in listed:
                typer.echo(f"written: {file}")
    if not written:
        typer.echo("nothing is written: all of it is there already, unchanged")
    if chosen.note:
        say(f"note: {chosen.note}")
    typer.echo("to go on, type:")
    if resolved(output) != Path.cwd():
        typer.echo(f"  cd {shlex.quote(str(output))}")
    for command in chosen.commands:
        typer.echo(f"  {command}")
    return print_ending(f"{output} holds the example {name}", "type the lines above")


_plugin = typer.Typer(help="Write a new plug-in, or check one.", no_args_is_help=True, rich_markup_mode=None)
guide_app.add_typer(_plugin, name="plugin")

# Where the config of each command is: module and class.
_CONFIGS = {
    "compare": ("omnibench.compare.config", "CompareConfig"),
    "design": ("omnibench.design.candidates", "DesignConfig"),
    "live": ("omnibench.live.config", "LiveConfig"),
    "simulate": ("omnibench.simulate.source", "SimulationConfig"),
    "study": ("omnibench.compare.config", "CompareConfig"),
}


@guide_app.command("list")
def list_(
    kind: Literal["calibrators", "costs", "effects", "importers"] | None = argument(
        "Show what each of a kind is and where it comes from. Default: the names of all."
    ),
    plugins: list[Path] | None = shared.PLUGINS,
    as_json: bool = shared.JSON,
) -> None:
    """List calibrators, costs, effects and importers.

    Those of one kind each with where it comes from: built in, a plug-in's file, or an installed package.
    """
    from omnibench.registry import REGISTRIES, Entry
    from omnibench.report.blocks import Column, Row, Table
    from omnibench.report.terminal import print_table

    failures = shared.load_given_plugins(plugins)
    entries = {f"{registry.kind}s": registry.entries() for registry in REGISTRIES}
    if kind is not None:
        entries = {kind: entries[kind]}
    if as_json:
        # All that a config can name, with the JSON schema of its options, and the plug-ins that failed.
        def row(entry: Entry[object]) -> dict[str, object]:
            options = entry.options.model_json_schema().get("properties", {})
            return {"name": entry.name, "summary": entry.summary, "from": entry.origin, "options": options}

        named = {name: [row(entry) for entry in listed] for name, listed in entries.items()}
        failed = [{"from": failure.origin, "error": failure.error} for failure in failures]
        return print_json({**named, "failures": failed})
    what = "all of these may be named in configs"
    if kind is None:
        names = {f"{name} ({len(listed)})": ", ".join(e.name for e in listed) for name, listed in entries.items()}
        print_names(names, _NAME_WIDTH)
        return print_ending(what, "see what those of a kind are", "omnibench", "list", "calibrators")
    columns = tuple(Column(heading, numeric=False) for heading in ("name", "what", "from"))
    rows = tuple(Row.of(entry.name, entry.summary, entry.origin) for entry in entries[kind])
    print_table(make_console(), Table(kind, columns, rows))
    return print_ending(what, "read how to choose", "omnibench", "guide", "calibrators")


@guide_app.command()
def schema(
    kind: Literal["compare", "design", "live", "simulate", "study"] = argument(
        "Which command's config.", default="compare"
    ),
) -> None:
    """Print the JSON schema of a config, for editors."""
    module, name = _CONFIGS[kind]
    config: type[BaseModel] = getattr(import_module(module), name)
    print_json(config.model_json_schema(by_alias=True))
    print_ending(f"this is the JSON schema of configs for {kind}", "write it to a file and name that in your editor")


@_plugin.command("new")
def plugin_new(
    name: str = argument("Name of the plug-in in configs.", ...),
    kind: str | None = option("calibrator, importer, cost or effect. Default: calibrator.", metavar="KIND"),
    effect: bool = flag("Short for --kind effect.", "--effect"),
    folder: Path = option("Folder to write to.", "--folder", "-o", "--output", default=Path("plugins"), metavar="DIR"),
    force: bool = shared.FORCE,
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
    file: Path = argument("Plug-in file.", ...),
    sample: Path | None = option("Sample recordings for an importer to read."),
    seconds: float = option("Longest time of the whole check, in s.", default=600.0, min=0.1),
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
