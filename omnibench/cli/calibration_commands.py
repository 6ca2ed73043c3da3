"""``calibrate``, ``evaluate``, ``certify`` and ``export``: one calibration, from the fit to other software."""

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from omnibench.cli.options import Json, Plugins, Settings, load_given_plugins
from omnibench.cli.terminal.console import make_console, print_json, warn
from omnibench.errors import ConfigError

if TYPE_CHECKING:
    pass

calibration_app = typer.Typer()


@calibration_app.command()
def calibrate(
    dataset: Annotated[Path, typer.Argument(help="A data set folder.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="The calibration file to write.")] = None,
    calibrator: Annotated[str, typer.Option(help="See omnibench list.")] = "closed_form",
    cost: Annotated[str, typer.Option(help="See omnibench list.")] = "final_pose",
    parameterisation: Annotated[
        Literal["matrix", "geometry"] | None, typer.Option(help="What is searched. Default: the calibrator's own.")
    ] = None,
    box: Annotated[Literal["paper", "row"], typer.Option(help="paper: +-10 % of each element; row: wider.")] = "row",
    integration: Annotated[Literal["euler", "arc"], typer.Option(help="Euler: the paper's step.")] = "arc",
    seed: Annotated[int, typer.Option(min=0)] = 1,
    evaluations: Annotated[int, typer.Option(min=1, help="Budget.")] = 60_000,
    seconds: Annotated[float, typer.Option(min=0.001, help="Budget.")] = 600.0,
    intervals: Annotated[bool, typer.Option("--intervals", help="Also bootstrap intervals (closed_form).")] = False,
    unidentified: Annotated[
        Literal["keep", "fit"],
        typer.Option(help="Motions that the data hardly drive: keep the design values, or fit them to slip and noise."),
    ] = "keep",
    settings: Settings = None,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Fit the odometry model of a data set's training split and write the calibration file."""
    from omnibench.cli.terminal.calibration_tables import print_calibration
    from omnibench.cli.terminal.progress import EvaluationsBar
    from omnibench.config import parse_settings
    from omnibench.data.storage import load_dataset
    from omnibench.fit.calibrate import calibrate as fit
    from omnibench.fit.problem import Budget
    from omnibench.registry import calibrators, costs
    from omnibench.robot.calibration import write_calibration

    load_given_plugins(plugins)
    calibrators.entry(calibrator, "--calibrator")
    costs.entry(cost, "--cost")
    if output is None and not as_json:
        raise ConfigError("say where the calibration goes: -o calibration.yaml")
    recordings = load_dataset(dataset)
    with redirect_stdout(sys.stderr), EvaluationsBar(calibrator, evaluations) as watch:
        run = fit(
            recordings,
            calibrator,
            options=parse_settings(settings),
            cost=cost,
            parameterisation=parameterisation,
            box=box,
            integration=integration,
            budget=Budget(evaluations=evaluations, seconds=seconds),
            seed=seed,
            intervals=intervals,
            unidentified=unidentified,
            watch=watch,
        )
    calibration, result = run.calibration, run.result
    if output is not None:
        write_calibration(calibration, output)
    warn([*recordings.warnings, *run.warnings])
    if result.at_bounds:
        warn([f"{', '.join(result.at_bounds)} lie on a bound of the box {box!r}; a wider box may fit better"])
    if result.held:
        warn([f"{', '.join(result.held)} keep their start values (box {box!r}, cost {cost!r})"])
    if as_json:
        return print_json(calibration)
    print_calibration(make_console(), run)
    typer.echo(f"calibration: {output}")
    return None


@calibration_app.command()
def evaluate(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="A data set folder.")],
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Cost and final errors of a calibration on a data set."""
    from omnibench.cli.terminal.calibration_tables import print_evaluation
    from omnibench.data.storage import load_dataset
    from omnibench.fit.evaluate import evaluate as judge
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    recordings = load_dataset(dataset)
    evaluation = judge(read_calibration(calibration), recordings)
    warnings = [*recordings.warnings, *evaluation.warnings]
    warn(warnings)
    if as_json:
        document: dict[str, Any] = {"dataset": evaluation.dataset, "trajectories": evaluation.trajectories}
        document["splits"] = {
            name: errors.model_dump(exclude={"trajectories"}) for name, errors in evaluation.splits.items()
        }
        return print_json(document | {"warnings": warnings})
    return print_evaluation(make_console(), evaluation)


@calibration_app.command()
def certify(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="A data set folder.")],
    box: Annotated[
        Literal["paper", "row"] | None,
        typer.Option(help="paper: +-10 % of each element; row: wider. Default: the box it was searched in, or row."),
    ] = None,
    gap: Annotated[float, typer.Option(min=1e-9, max=0.999, help="Stop when this share of the cost is left.")] = 1e-3,
    seconds: Annotated[float, typer.Option(min=0.0, help="Or after this time; what is proven by then holds.")] = 60.0,
    plugins: Plugins = None,
    as_json: Json = False,
) -> None:
    """Prove how much better than a calibration any matrix of the box could be, on the training split."""
    from omnibench.cli.terminal.calibration_tables import print_certificate
    from omnibench.cli.terminal.progress import ProofLine
    from omnibench.data.storage import load_dataset
    from omnibench.fit.certify import certify_optimum
    from omnibench.robot.calibration import read_calibration

    load_given_plugins(plugins)
    recordings = load_dataset(dataset)
    with ProofLine() as watch:
        certified = certify_optimum(
            read_calibration(calibration), recordings, box=box, gap=gap, seconds=seconds, watch=watch
        )
    warn(recordings.warnings)
    if not certified.inside:
        warn([f"the calibration is outside the box {certified.certificate.box!r}, of which the bound speaks"])
    if as_json:
        return print_json(certified.certificate)
    return print_certificate(make_console(), certified)


@calibration_app.command()
def export(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    to: Annotated[str, typer.Option("--to", help="ros2_controllers or c_header.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; default: standard output.")
    ] = None,
    plugins: Plugins = None,
) -> None:
    """Write a calibration for other software."""
    from omnibench.files import write_text
    from omnibench.robot.calibration import read_calibration
    from omnibench.robot.export.formats import export_calibration

    load_given_plugins(plugins)
    exported = export_calibration(read_calibration(calibration), to)
    warn(exported.warnings)
    if output is None:
        typer.echo(exported.text, nl=False)
    else:
        file = output / exported.file_name if output.is_dir() else output
        write_text(file, exported.text)
        typer.echo(f"{to}: {file}")
