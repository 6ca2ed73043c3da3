"""The options of ``calibrate``: one for every choice of FitSettings, made when the command is called.

``omnibench --help`` makes none of them, and so imports nothing of the fit.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

if TYPE_CHECKING:
    from pydantic import BaseModel

    from omnibench.fit.settings import FitSettings

_TYPES: dict[str, Any] = {"string": str, "integer": int, "number": float, "boolean": bool}


class FitCommand(TyperCommand):
    """A command whose options are those of its function, and one for each field of FitSettings.

    The function reads the values of the latter from ``context.obj``, a mapping by field name.
    """

    _choices: tuple[str, ...] = ()

    def get_params(self, ctx: Any) -> list[Any]:
        """The command's options and arguments; the options of FitSettings come after ``--output``."""
        if not self._choices:
            from omnibench.fit.settings import FitSettings

            made = options_of(FitSettings)
            self._choices = tuple(option.name for option in made)
            after = 1 + [parameter.name for parameter in self.params].index("output")
            self.params[after:after] = made
        return super().get_params(ctx)

    def invoke(self, ctx: Any) -> Any:
        """Call the function, with the values of FitSettings' options in ``ctx.obj``."""
        ctx.obj = {name: ctx.params.pop(name) for name in self._choices}
        return super().invoke(ctx)


def options_of(model: type[BaseModel]) -> list[Any]:
    """Options of a command line for the fields of a model, and of models in it, that are text, a number or a flag."""

    def chosen() -> None: ...

    parameters = list(_parameters(model))
    chosen.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    chosen.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    app = typer.Typer(add_completion=False)
    app.command()(chosen)
    command: Any = typer.main.get_command(app)
    return list(command.params)


def _parameters(model: type[BaseModel]) -> Iterator[inspect.Parameter]:
    """Parameters of a function, from which Typer makes options: one for each field of a model."""
    from pydantic import BaseModel

    properties = model.model_json_schema()["properties"]
    for name, field in model.model_fields.items():
        if isinstance(field.default, BaseModel):
            yield from _parameters(type(field.default))
            continue
        kinds = properties[name].get("anyOf", [properties[name]])
        schema = next((kind for kind in kinds if kind.get("type") in _TYPES), None)
        if schema is None:
            continue
        annotation: Any = Literal[tuple(schema["enum"])] if "enum" in schema else _TYPES[schema["type"]]
        least = schema.get("minimum", schema.get("exclusiveMinimum"))
        least = least + 1 if annotation is int and "exclusiveMinimum" in schema else least
        flag = [f"--{name}"] if annotation is bool else []
        option = typer.Option(*flag, help=field.description, min=least)
        annotation = annotation | None if field.default is None else annotation
        yield inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=Annotated[annotation, option]
        )


def chosen_settings(context: typer.Context, options: dict[str, Any]) -> FitSettings:
    """Settings by the option values of a FitCommand, which are in its context. options: those of the calibrator.

    UnknownNameError: there is no such calibrator or cost. ConfigError: a value is wrong.
    """
    from omnibench.config import validate
    from omnibench.fit.settings import Budget, FitSettings
    from omnibench.registry import calibrators, costs

    choices = {name: value for name, value in context.obj.items() if value is not None}
    if "calibrator" in choices:
        calibrators.entry(choices["calibrator"], "--calibrator")
    if "cost" in choices:
        costs.entry(choices["cost"], "--cost")
    budget = {name: choices.pop(name) for name in Budget.model_fields}
    return validate(FitSettings, choices | {"budget": budget, "options": options}, "calibrate")
