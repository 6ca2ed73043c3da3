"""Chromium, in which reports are opened by the tests."""

from __future__ import annotations

import re
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


_MEASURE = """<script>
const drawn = setInterval(() => {
  if (document.body.dataset.plots !== "drawn") return;
  clearInterval(drawn);
  const box = document.querySelector(".canvas").getBoundingClientRect();
  document.body.dataset.picture = Math.round(box.bottom + scrollY);
  document.body.dataset.width = document.documentElement.scrollWidth;
}, 50);
</script>"""


def first_picture(page: Path, width: int = 1280) -> tuple[int, int]:
    """Bottom edge of a report's first picture and width of the whole page, px, in a window of that width."""
    copy = page.with_name("measured.html")
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", f"{_MEASURE}</body>"), encoding="utf-8")
    drawn, _ = opened(copy, f"--window-size={width},900")
    found = [re.search(rf'data-{name}="(\d+)"', drawn) for name in ("picture", "width")]
    assert all(found), "the page did not finish drawing"
    return int(found[0].group(1)), int(found[1].group(1))


def opened(page: Path, *flags: str) -> tuple[str, list[str]]:
    """The page after its scripts have run, and what it wrote to the console; the browser's own pages are left out.

    The test is skipped where there is no Chromium.
    """
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("no Chromium on this machine to draw the report with")
    command = [program, *FLAGS, *flags, f"--user-data-dir={page.parent / 'profile'}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line and "chrome://" not in line]
