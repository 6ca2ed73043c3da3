"""Chromium, in which reports are opened by the tests."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from timing import PATIENCE

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--enable-logging=stderr"),
    *("--virtual-time-budget=20000", "--dump-dom"),
)


def opened(page: Path) -> tuple[str, list[str]]:
    """The page after its scripts have run, and what it wrote to the console; the browser's own pages are left out.

    The test is skipped where there is no Chromium.
    """
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("no Chromium on this machine to draw the report with")
    command = [program, *FLAGS, f"--user-data-dir={page.parent / 'profile'}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line and "chrome://" not in line]
