"""Options and arguments that several commands share, and the plug-ins that ``--plugins`` names.

Where a model holds what a command was asked for, as FitSettings for ``calibrate``, its fields are the options: their
names, defaults, limits and descriptions. The model is imported when the command is called, not by ``omnibench --help``.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_type_hints

import typer
from typer.core import TyperCommand

from omnibench.cli.terminal.console import warn
from omnibench.errors import ConfigError, PluginError
from omnibench.files import refuse_existing

if TYPE_CHECKING:
    from pydantic import BaseModel

    from omnibench.jobs.job import Backend, TlsFiles
    from omnibench.progress import Reporter
    from omnibench.registry import PluginFailure
    from omnibench.report.blocks import Document


def option(text: str, *names: str, default: Any = None, **settings: Any) -> Any:
    """An option of a command, as the default of its parameter. text: its help. default: ``...`` if it must be given."""
    return typer.Option(default, *names, help=text, **settings)


def argument(text: str, default: Any = None, **settings: Any) -> Any:
    """An argument of a command, as the default of its parameter. text, default: as of an option."""
    return typer.Argument(default, help=text, **settings)


def flag(text: str, *names: str) -> Any:
    """An option without a value, which is False unless it is given. text: its help."""
    return option(text, *names, default=False)


def output_option(text: str, **settings: Any) -> Any:
    """``-o`` and ``--output``: the same two spellings for every command that writes files."""
    return option(text, "-o", "--output", **settings)


def names_in(place: str) -> Callable[[], list[str]]:
    """Tab completion by the names of what a place holds: module:attribute, or a function there that takes nothing.

    Names of plug-ins are not among them, since no plug-in is run while somebody types.
    """

    def names() -> list[str]:
        from pkgutil import resolve_name

        held = resolve_name(place)
        return [getattr(each, "name", each) for each in (held() if callable(held) else held)]

    return names


IMPORTER_NAMES = names_in("omnibench.registry:importers.entries")
# What completion and help know of a model's field, by its name.
_NAMES = {
    "calibrator": names_in("omnibench.registry:calibrators.entries"),
    "cost": names_in("omnibench.registry:costs.entries"),
    "effect": names_in("omnibench.registry:effects.entries"),
    "effects": names_in("omnibench.registry:effects.entries"),
    "robots": names_in("omnibench.simulate.exam:ROBOTS"),
    "without": names_in("omnibench.registry:effects.entries"),
}
_METAVARS = {
    "area": "AxB", "effect": "YAML", "effects": "NAME,...", "like": "DATASET", "model": "CALIBRATION", "robot": "FILE",
    "robots": "NAME,...", "truth": "DIR", "without": "NAME",
}  # fmt: skip


class _Place(str):
    """Where a model is: module:class."""


def options_of(place: str) -> Any:
    """Default of a ModelCommand's parameter that stands for a model, module:class; its fields become options.

    Not those fields that are parameters of the command by themselves, nor those that no option can hold.
    """
    return _Place(place)


def grouped(function: Callable[..., None]) -> Callable[..., None]:
    """Decorator of a command, for which a parameter that is a group of options by default adds all of them.

    A group is a dataclass whose fields are options, or ``options_of`` a model; the command gets one with the values
    that were given.
    """
    groups, model = dict[str, Any](), None
    parameters = [inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)]
    for parameter in inspect.signature(function).parameters.values():
        group = parameter.default
        if isinstance(group, _Place):
            model = parameter.name, group, len(parameters) - 1
        elif is_dataclass(group):
            groups[parameter.name], types = group, get_type_hints(type(group))
            for field in fields(group):
                default = getattr(group, field.name)
                parameters.append(parameter.replace(name=field.name, default=default, annotation=types[field.name]))
        else:
            parameters.append(parameter)

    @wraps(function)
    def command(context: typer.Context, **given: Any) -> None:
        for name, group in groups.items():
            given[name] = replace(group, **{field.name: given.pop(field.name) for field in fields(group)})
        function(**given, **(context.obj or {}))

    command.__dict__["model"] = model
    return _with_parameters(command, parameters)


def _with_parameters(function: Callable[..., None], parameters: list[inspect.Parameter]) -> Callable[..., None]:
    """Declare the parameters of which Typer makes a command's options and arguments."""
    function.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    function.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return function


class ModelCommand(TyperCommand):
    """A command with options that are the fields of a model, by ``options_of`` in its ``grouped`` function."""

    _model: Any = None
    _made: tuple[str, ...] = ()  # names of the options that are the model's

    def get_params(self, ctx: Any) -> list[Any]:
        """The command's options and arguments; those of the model stand in the place of the function's parameter."""
        if self._model is None:
            from pkgutil import resolve_name

            _, place, index = self.callback.model  # type: ignore[union-attr]
            self._model = resolve_name(place)
            known = {parameter.name for parameter in self.params}
            app = typer.Typer(add_completion=False)
            made = [parameter for parameter in _parameters(self._model) if parameter.name not in known]
            app.command()(_with_parameters(lambda: None, made))
            self._made = tuple(parameter.name for parameter in made)
            self.params[index:index] = typer.main.get_command(app).params
        return super().get_params(ctx)

    def invoke(self, ctx: Any) -> Any:
        """Call the function with the model. ConfigError in one line: a value is wrong."""
        from omnibench.config import validate

        parameter, _, _ = self.callback.model  # type: ignore[union-attr]
        ctx.obj = {parameter: validate(self._model, _values(self._model, ctx.params), str(self.name))}
        for name in self._made:
            del ctx.params[name]
        return super().invoke(ctx)


_TYPES: dict[str, Any] = {"string": str, "integer": int, "number": float, "boolean": bool}


def _parameters(model: type[BaseModel]) -> Iterator[inspect.Parameter]:
    """Parameters of a function, from which Typer makes options: one for each field of a model, and of those within.

    Help and completion know of a field what ``_METAVARS`` and ``_NAMES`` say.
    """
    from pydantic import BaseModel

    properties = model.model_json_schema()["properties"]
    for name, field in model.model_fields.items():
        if isinstance(field.default, BaseModel):
            yield from _parameters(type(field.default))
            continue
        kinds: list[dict[str, Any]] = properties[name].get("anyOf", [properties[name]])
        schema = next((kind for kind in kinds if "type" in kind), {})
        several = schema.get("type") == "array"
        schema = schema.get("items", {}) if several else schema
        if schema.get("type") not in _TYPES:
            continue
        annotation: Any = Path if schema.get("format") == "path" else _TYPES[schema["type"]]
        annotation = Literal[tuple(schema["enum"])] if "enum" in schema else annotation
        least = schema.get("minimum", schema.get("exclusiveMinimum"))
        if annotation is int and "exclusiveMinimum" in schema:
            least = schema["exclusiveMinimum"] + 1
        made = option(
            field.description or "",
            *([f"--{name.replace('_', '-')}"] if field.default is False else []),
            default=None if several else field.default,
            min=least,
            metavar=_METAVARS.get(name),
            autocompletion=_NAMES.get(name),
        )
        annotation = list[annotation] if several else annotation
        annotation = annotation | None if made.default is None else annotation
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=made, annotation=annotation)


def _values(model: type[BaseModel], given: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a model's fields, of those within by their names; None was not given."""
    from pydantic import BaseModel

    within = {name: type(field.default) for name, field in model.model_fields.items()}
    values = {name: _values(kind, given) for name, kind in within.items() if issubclass(kind, BaseModel)}
    return values | {name: given[name] for name in model.model_fields if given.get(name) is not None}


DATASETS = argument("Data set folder; several of one robot, or a glob, count as one.", ..., metavar="DATASET...")
CALIBRATION = argument("Calibration file.", ...)
JSON = flag("Print one JSON document on standard output, and nothing else.", "--json")
FORCE = flag("Replace what is there already.", "--force")
FIGURES = option("Also write each figure of the report, as SVG and PNG (by Chromium or Chrome).", metavar="DIR")
SETTINGS = option("Set an option, its value in YAML; may be repeated.", "--set", metavar="KEY=VALUE")
TableFormat = Literal["parquet", "csv"]
TABLE_FORMAT = option("Format of the data set's tables.", "--format", default="parquet")
PLUGINS = option(
    "Folder of plug-ins; may be repeated. Default: ./plugins, if any; none: load none.",
    "--plugins",
    metavar="DIR",
    envvar="OMNIBENCH_PLUGINS",
)

# Modules that jobs which read a data set share.
_READING = ("omnibench.check.evidence", "omnibench.robot.compiled_beforehand")


@dataclass(frozen=True)
class BackendOptions:
    """Options that say where many jobs are run: by default in this process."""

    backend: str | None = option(
        "Where many jobs are run: processes; dask (a cluster started here); tcp://HOST:PORT or tls://HOST:PORT, "
        "a scheduler of Dask.",
        metavar="NAME",
    )
    workers: int | None = option("For --backend: processes, or Dask workers started here. Default: processors.", min=1)
    tls_ca: Path | None = option("For tls://: the authority's certificate.", metavar="FILE")
    tls_cert: Path | None = option("For tls://: this client's certificate.", metavar="FILE")
    tls_key: Path | None = option("For tls://: this client's key.", metavar="FILE")

    @property
    def tls(self) -> TlsFiles | None:
        """The files of the options; None without any. ConfigError: some are given, not all."""
        ca, cert, key = self.tls_ca, self.tls_cert, self.tls_key
        if ca is None and cert is None and key is None:
            return None
        if ca is None or cert is None or key is None:
            raise ConfigError("TLS needs three files: --tls-ca, --tls-cert and --tls-key")
        from omnibench.jobs.job import TlsFiles

        return TlsFiles(ca=ca.resolve(), cert=cert.resolve(), key=key.resolve())

    @contextmanager
    def opened(self, report: Reporter, *preload: str) -> Iterator[Backend | None]:
        """The backend, open in the block; None where none was given: this process does the work.

        In the block its workers read data sets larger than memory, of which ``report`` is told. preload: modules that
        all jobs import.
        """
        from omnibench.progress import reading_told_to

        tls = self.tls
        if self.backend is None:
            if self.workers is not None or tls is not None:
                raise ConfigError("--workers and the files of TLS are for --backend; name one")
            with reading_told_to(report):
                yield None
            return
        from omnibench.jobs.backend_choice import BackendChoice, open_backend
        from omnibench.robot.stored_odometry import read_by

        choice = BackendChoice(name=self.backend, workers=self.workers or os.cpu_count() or 1, tls=tls)
        with open_backend(choice, (*_READING, *preload), report) as backend, read_by(backend), reading_told_to(report):
            yield backend


@dataclass(frozen=True)
class ReportOptions:
    """Options of the commands that write a page on request."""

    report: Path | None
    figures: Path | None = FIGURES

    @property
    def asked(self) -> bool:
        """True if either is asked for."""
        return self.report is not None or self.figures is not None

    def refuse(self, *, force: bool) -> None:
        """Check before the work begins. ConfigError: the page is there already. DataError: no browser draws figures."""
        refuse_existing(self.report, force=force)
        refuse_figures_without_browser(self.figures)

    def write(self, page: Callable[[], Document], *, announced: bool = False) -> None:
        """Write the page and its figures; it is made only where either is asked for.

        announced: say on standard error where the page is.
        """
        if not self.asked:
            return
        from omnibench.report.render import write_document

        document = page()
        if self.report is not None:
            write_document(document, self.report)
            if announced:
                typer.echo(f"report: {self.report}", err=True)
        write_asked_figures(document, self.figures)


def report_options(text: str) -> ReportOptions:
    """The options ``--report``, of which ``text`` is the help, and ``--figures``."""
    return ReportOptions(report=option(text, metavar="FILE.html"))


def refuse_figures_without_browser(folder: Path | None) -> None:
    """DataError, before the work begins: figures are asked for, and nothing here can draw them."""
    if folder is not None:
        from omnibench.report.figure_files import browser

        browser()


def write_asked_figures(document: Document, folder: Path | None) -> None:
    """Write the figures of a report to the folder of ``--figures``, if it was given, and say how many there are."""
    if folder is not None:
        from omnibench.report.figure_files import write_figures

        names = write_figures(document, folder)
        if names:
            typer.echo(f"figures: {folder} ({len(names)}, each as SVG and PNG; the first: {names[0]}.svg)", err=True)
        else:
            typer.echo("figures: none in the report", err=True)


def plugin_folders(given: Sequence[Path] | None) -> list[Path]:
    """The folders that were given; by default ./plugins, if it holds plug-ins, which standard error then says."""
    if given:
        return [folder for folder in given if folder != Path("none")]
    if given is not None or not any(Path("plugins").glob("*.py")):
        return []
    typer.echo("plug-ins of ./plugins are loaded; --plugins none loads none", err=True)
    return [Path("plugins")]


def load_given_plugins(given: Sequence[Path] | None, files: Sequence[Path] | None = None) -> list[PluginFailure]:
    """Load the plug-ins of the given folders, or of the default one, and warn on standard error of those that fail.

    files: single plug-in files to load, too. PluginError: a folder does not exist, or one of the files fails.
    """
    from omnibench.registry import load_plugin_file, load_plugins

    with redirect_stdout(sys.stderr):  # a plug-in that prints must not spoil our output
        for file in files or ():
            if not file.is_file():
                raise PluginError(f"{file}: no such plug-in file")
            if (failure := load_plugin_file(file)) is not None:
                raise PluginError(f"plug-in {failure.origin} cannot be imported: {failure.error}")
        failures = load_plugins(plugin_folders(given))
    for failure in failures:
        warn([f"plug-in {failure.origin} cannot be imported: {failure.error}"])
    return failures
