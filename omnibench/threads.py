"""One thread for linear algebra on small matrices, where more only wait for each other on a busy machine."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[object]:
    """While it is open, NumPy's and SciPy's matrix products run in the caller's thread alone."""
    limiter: AbstractContextManager[object] = _controller().limit(limits=1)
    return limiter


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")
