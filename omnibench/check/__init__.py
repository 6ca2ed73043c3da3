"""Check of recordings: one ordered list of detectors, each of which gives findings.

The room has the name of its one public function, so that ``omnibench.check`` may be either: calling it checks.
"""

import sys
from types import ModuleType
from typing import Any


class _CallableRoom(ModuleType):
    """This package, which is called as its one public function."""

    __module__ = "omnibench.check.check"  # where that stands

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self.__wrapped__(*arguments, **options)

    @property
    def __wrapped__(self) -> Any:
        from omnibench.check.check import check

        return check


sys.modules[__name__].__class__ = _CallableRoom
