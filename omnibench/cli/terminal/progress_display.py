"""Progress of a command while it works: bars on a terminal, plain lines in a pipe."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Final

from omnibench.cli.terminal.console import make_console
from omnibench.words import plural

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

    from omnibench.progress import Progress

_PERIOD: Final = 10.0  # s between two lines of tasks that go on, in a pipe; chosen
_BAR: Final = 24  # columns of a bar at most, and a sixth of a narrow terminal; chosen


class ProgressDisplay:
    """A reporter that shows tasks, by default on standard error.

    On a terminal each task has a bar until it is over. In a pipe a line says that a task begins, unless another goes
    on; every ``period`` s at most, a line says how far a task is. The result of a task is a line that stays.
    """

    def __init__(self, console: Console | None = None, period: float = _PERIOD) -> None:
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn  # slow to import
        from rich.progress import Progress as Bars
        from rich.table import Column

        self.console = console or make_console(error=True)
        self._bars = Bars(
            TextColumn("{task.description}", markup=False, table_column=Column()),
            BarColumn(min(_BAR, self.console.width // 6), table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[state]}", markup=False, table_column=Column()),
            TimeElapsedColumn(table_column=Column(no_wrap=True)),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._period = period
        self._said = time.monotonic()  # when the last line was printed

    def __enter__(self) -> ProgressDisplay:
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def __call__(self, event: Progress) -> None:
        parts = []
        if event.total is not None:
            parts.append(f"{event.done:,} of {event.total:,}")
        elif event.done:
            parts.append(plural(event.done, event.unit))
        if event.best is not None and math.isfinite(event.best):
            parts.append(f"best {event.best:.6f}")
        state = ", ".join([*parts, *([event.note] if event.note else [])])
        if not self.console.is_terminal and not event.over:
            # A line in a pipe, if there is something to say and it is time.
            if not self._tasks and not event.done:
                of_all = "" if event.total is None else f": {plural(event.total, event.unit)}"
                self.keep(f"{event.task}{of_all}")
            elif state and time.monotonic() - self._said >= self._period:
                self.keep(f"{event.task}: {state}")
        if event.task not in self._tasks:
            self._bars.start()  # only now is there something to show
            self._tasks[event.task] = self._bars.add_task(event.task, total=event.total, state=state)
        self._bars.update(self._tasks[event.task], completed=event.done, state=state)
        if event.over:
            self._bars.remove_task(self._tasks.pop(event.task))
            self._bars.refresh()  # so that the bar is gone before the result stands above all bars
        if event.result:
            self.keep(event.result)

    def keep(self, line: str) -> None:
        """Print a line that stays."""
        self.console.print(line, soft_wrap=True, markup=False, highlight=False)
        self._said = time.monotonic()
