"""``exam make`` and ``exam grade``: data sets with hidden effects, and marks for whoever looks for them."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from omnibench.cli import options as shared
from omnibench.cli.options import argument, option, options_of
from omnibench.cli.terminal.console import print_ending, show
from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.simulate.exam import ExamOptions

exam_app = typer.Typer(
    help="Set an exam with hidden effects, or grade one.", no_args_is_help=True, rich_markup_mode=None
)
_EXAM = argument("Folder of the exam.", ..., metavar="DIR")


@exam_app.command(cls=shared.ModelCommand)
@shared.grouped
def make(
    folder: Path = _EXAM,
    asked: "ExamOptions" = options_of("omnibench.simulate.exam:ExamOptions"),
    seed: int | None = option("Make an exam again, or go on with one. Default: drawn, and printed.", min=0),
) -> None:
    """Write data sets with hidden effects, and a sealed key.

    Each set is one robot's recordings, with none, one or two hidden effects that they can show. What is hidden follows
    from a seed, which is printed and written nowhere; sealed.json holds a hash of it and of the key.
    """
    from omnibench.simulate.exam import make_exam
    from omnibench.simulate.exam_marks import answer_schema

    with ProgressDisplay() as watch:
        seed = make_exam(folder, asked, answer_schema(), seed, watch)
    typer.echo(f"seed {seed} (keep this: it opens the exam)")
    first = folder / "set-001"
    holds = f"{folder} holds {plural(asked.sets, 'set')}"
    print_ending(holds, "sit it, set by set", "omnibench", "discover", first, "-o", f"answers/{first.name}")


@exam_app.command()
def grade(
    folder: Path = _EXAM,
    answers: Path = argument(
        "ANSWERS.json (sealed.json has its schema), or a folder of SET/discovery.json.", ..., metavar="ANSWERS"
    ),
    seed: int = option("Seed that exam make printed.", default=..., min=0),
    as_json: bool = shared.JSON,
) -> None:
    """Open an exam by its seed, and grade the answers."""
    from omnibench.cli.terminal.exam_result import ExamResult
    from omnibench.simulate.exam import open_exam, read_sealed
    from omnibench.simulate.exam_marks import mark_exam, read_answers

    answered = read_answers(answers, dict.fromkeys(read_sealed(folder).sets))
    with ProgressDisplay() as watch:
        configs = open_exam(folder, seed, watch)
    show(ExamResult(mark_exam(configs, answered)), as_json)
