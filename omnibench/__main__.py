"""``omnibench`` and ``python -m omnibench``: every mistake is one line on standard error and an exit code.

Ctrl-C and SIGTERM are handled from the first line on; therefore nothing that takes time is imported before ``main``
runs. The exit code is 128 and the signal's number.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # the core of ``signal``, which takes 10 ms to import
import gc
import os
import sys

TYPE_CHECKING = False  # that of ``typing`` would take its import
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any, NoReturn

_PACKAGE = os.path.dirname(__file__)
_INTERRUPTED = 130  # exit code after Ctrl-C; of another signal once it has come
# Not imported by another program, nor by a process that this one starts for its jobs.
_PROGRAM = __name__ == "__main__" or (
    os.path.basename(sys.argv[0]) == "omnibench" and sys.modules["__main__"].__name__ != "__mp_main__"
)
_at_work = False  # True while ``main`` runs
_BEGINS_ANEW = "interrupted; the same command begins anew"  # where a command keeps nothing on the way
_COMMANDS = os.path.join(_PACKAGE, "cli")


def main() -> None:
    """Run the command line."""
    global _at_work
    _handle_signals()
    _at_work = True
    try:
        _run(_command_line())
    except KeyboardInterrupt:
        _fail("interrupted", _INTERRUPTED)
    finally:
        _at_work = False


def _handle_signals() -> None:
    """Take Ctrl-C and SIGTERM over, unless somebody else has."""
    for number, usual in ((_signal.SIGINT, _signal.default_int_handler), (_signal.SIGTERM, _signal.SIG_DFL)):
        if _signal.getsignal(number) == usual:
            try:
                _signal.signal(number, _interrupted)
            except ValueError:  # not in the main thread
                return


def _command_line() -> Any:
    """The command line as one command. What is made on the way stays: collecting garbage would only take time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        import typer

        from omnibench.cli.app import app

        return typer.main.get_command(app)
    finally:
        if collecting:
            gc.enable()


def _interrupted(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; end at once before and after the work, and during a command's imports.

    Libraries that are being imported make it errors of their own.
    """
    global _INTERRUPTED
    _INTERRUPTED = 128 + number
    if (_PROGRAM and not _at_work) or _imports_of_a_command(frame):
        os.write(2, b"interrupted\n")
        os._exit(_INTERRUPTED)
    _signal.default_int_handler(number, frame)


def _imports_of_a_command(frame: FrameType | None) -> bool:
    """True while ``main`` or a function of the commands' folder imports something: no work is under way yet."""
    importing = False
    while frame is not None:
        file = frame.f_code.co_filename
        importing = importing or file.startswith("<frozen importlib")
        if frame.f_code.co_name != "<module>" and file.startswith(_PACKAGE + os.sep):
            return importing and (file == __file__ or os.path.dirname(file) == _COMMANDS)
        frame = frame.f_back
    return False


def _run(command: Any) -> None:
    from io import TextIOWrapper

    import typer

    from omnibench.errors import Interrupted, OmnibenchError, not_computable

    _replace_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a letter that the terminal lacks becomes a ?
    for argument in sys.argv:
        if not argument.isprintable() and any("\udc80" <= letter <= "\udcff" for letter in argument):
            _fail(f"error: {argument}: this name is not in UTF-8; rename the file or folder")
    usage_error: Any = typer.BadParameter.__mro__[1]  # click's UsageError, wherever this Typer keeps it
    try:
        code = command.main(prog_name="omnibench", standalone_mode=False)
    except usage_error as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # nothing was typed: the message is the whole help
            _fail(error.format_message())
        _fail(_usage(error))
    except Interrupted as error:
        _fail(str(error), _INTERRUPTED)
    except OmnibenchError as error:
        _fail(_with_notes(f"error: {error}", error), error.exit_code)
    except typer.Abort:
        _fail(_BEGINS_ANEW, _INTERRUPTED)
    except BrokenPipeError:
        sys.stderr.close()  # the program that read our output has ended
        sys.exit(1)
    except UnicodeEncodeError as error:  # of a file's name that was found in a folder
        _fail(f"error: {error.object[:200]}: there is a name in it that is not in UTF-8; rename that file or folder")
    except MemoryError as error:
        _fail(_with_notes("error: out of memory; make the data or the budget smaller", error))
    except OSError as error:  # a disk or a terminal that failed unexpectedly
        _fail(_with_notes(f"error: {error.filename or 'output'}: {error.strerror or error}", error))
    except Exception as error:
        if (reason := not_computable(error)) is None:
            raise
        _fail(_with_notes(f"error: {reason}", error))
    else:
        if code == 130:  # newer versions of Typer return this after Ctrl-C
            _fail(_BEGINS_ANEW, _INTERRUPTED)
        sys.exit(code if isinstance(code, int) else 0)


def _replace_closed_streams() -> None:
    """Send to nowhere what would be printed on a stream that was closed before the start (``>&-``)."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 (open until the process ends)
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def _usage(error: Any) -> str:
    message = " ".join(error.format_message().split()).replace("Value error, ", "")
    context = error.ctx
    command = context.command_path if context else "omnibench"
    return f"error: {message} (see {command} --help)"


def _with_notes(message: str, error: Exception) -> str:
    """The message and what was noted with the error, such as the place of results that are kept."""
    return "; ".join([message, *getattr(error, "__notes__", ())])


def _fail(message: str, code: int = 2) -> NoReturn:
    print(message, file=sys.stderr)  # noqa: T201 (the one place where errors are printed)
    sys.exit(code)


if _PROGRAM:
    _handle_signals()
if __name__ == "__main__":
    main()
