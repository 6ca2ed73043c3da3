"""``omnibench`` and ``python -m omnibench``: every mistake is one line on standard error and an exit code.

Ctrl-C and SIGTERM are handled from the first line on; therefore nothing that takes time is imported before ``main``
runs. The exit code is 128 and the signal's number, whatever a library has made of the KeyboardInterrupt.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # the core of ``signal``, which takes 10 ms to import
import _thread
import gc
import os
import sys
import time

TYPE_CHECKING = False  # that of ``typing`` would take its import
if TYPE_CHECKING:
    from typing import Any, NoReturn

_BEGINS_ANEW = "interrupted; the same command begins anew"  # where a command keeps nothing on the way
_SEND_AGAIN = 0.05  # s after which an interrupt that Python ignored is sent again; chosen
# Not imported by another program, nor by a process that this one starts for its jobs.
_PROGRAM = __name__ == "__main__" or (
    os.path.basename(sys.argv[0]) == "omnibench" and sys.modules["__main__"].__name__ != "__mp_main__"
)

_at_work = False  # True while ``main`` runs
_signalled = 0  # number of the signal that interrupts the command; 0: none has come


def main() -> None:
    """Run the command line; ends in SystemExit."""
    global _at_work, _signalled
    _handle_signals()
    _signalled = 0
    report_ignored = sys.unraisablehook

    def send_again(ignored: sys.UnraisableHookArgs) -> None:
        """Send a Ctrl-C again that Python ignores, as it does in finalizers and callbacks of the garbage collector."""
        if ignored.exc_type is KeyboardInterrupt:
            _thread.start_new_thread(_interrupt_soon, ())
        else:
            report_ignored(ignored)

    sys.unraisablehook = send_again
    try:
        _at_work = True
        _run(_command_line())
    except (KeyboardInterrupt, Exception) as error:
        if not _signalled and not isinstance(error, KeyboardInterrupt):
            raise
        _end("interrupted", _interrupted_code())
    finally:
        _at_work = False
        sys.unraisablehook = report_ignored


def _handle_signals() -> None:
    """Take Ctrl-C and SIGTERM over, unless somebody else has."""
    for number, usual in ((_signal.SIGINT, _signal.default_int_handler), (_signal.SIGTERM, _signal.SIG_DFL)):
        if _signal.getsignal(number) == usual:
            try:
                _signal.signal(number, _interrupt)
            except ValueError:  # not in the main thread
                return


def _interrupt(number: int, _: object) -> None:
    """Raise KeyboardInterrupt; end at once before and after the work of the program."""
    global _signalled
    _signalled = number
    if _PROGRAM and not _at_work:
        os.write(2, b"interrupted\n")
        os._exit(_interrupted_code())
    raise KeyboardInterrupt


def _interrupt_soon() -> None:
    time.sleep(_SEND_AGAIN)
    if _at_work:
        os.kill(os.getpid(), _signalled or _signal.SIGINT)


def _interrupted_code() -> int:
    return 128 + int(_signalled or _signal.SIGINT)


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


def _run(command: Any) -> None:
    """Run the command that was typed, and end with its exit code, after one line if it fails."""
    import typer

    from omnibench.errors import Interrupted, explain

    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed before the start (``>&-``): what is printed goes nowhere
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (until the process ends)
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a letter that the terminal lacks becomes a ?
    try:
        for argument in sys.argv:
            argument.encode()
        code = command.main(prog_name="omnibench", standalone_mode=False)
    except (Interrupted, typer.Abort) as error:
        _end(str(error) or _BEGINS_ANEW, _interrupted_code())
    except BrokenPipeError:
        sys.stderr.close()  # the program that read our output has ended
        sys.exit(1)
    except Exception as error:
        message = None if _signalled else explain(error)  # after a signal ``main`` says so
        if message is None:
            raise
        notes = getattr(error, "__notes__", ())  # such as the place of results that are kept
        said = "; ".join([f"error: {message}", *notes])
        # Where nothing was typed the message is the whole help.
        _end(message if type(error).__name__ == "NoArgsIsHelpError" else said, getattr(error, "exit_code", 2))
    if code == 130:  # newer versions of Typer return this after Ctrl-C
        _end(_BEGINS_ANEW, _interrupted_code())
    if _signalled:  # a library has caught the interrupt
        _end("interrupted", _interrupted_code())
    sys.exit(code if isinstance(code, int) else 0)


def _end(message: str, code: int) -> NoReturn:
    global _at_work
    _at_work = False  # another Ctrl-C ends at once
    print(message, file=sys.stderr)  # noqa: T201 (the one place where errors are printed)
    sys.exit(code)


if _PROGRAM:
    _handle_signals()
if __name__ == "__main__":
    main()
