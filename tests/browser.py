"""Chromium, in which reports are opened by the tests."""

import re
import subprocess
from pathlib import Path

import pytest
from timing import PATIENCE

from omnibench.errors import DataError
from omnibench.report.figure_files import browser

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


def assert_picture_comes_first(page: Path) -> None:
    """Assert that a report's first picture lies in the first 900 pixels, and that no part is wider than the window."""
    copy = page.with_name("measured.html")
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", f"{_MEASURE}</body>"), encoding="utf-8")
    drawn, _ = opened(copy, "--window-size=1280,900")
    found = [re.search(rf'data-{name}="(\d+)"', drawn) for name in ("picture", "width")]
    assert all(found), "the page did not finish drawing"
    assert int(found[0].group(1)) <= 900
    assert int(found[1].group(1)) <= 1280


def chromium() -> str:
    """The browser that draws; the test is skipped where there is none."""
    try:
        return browser()
    except DataError as lacking:
        pytest.skip(str(lacking))


def opened(page: Path, *flags: str) -> tuple[str, list[str]]:
    """The page after its scripts have run, and what it wrote to the console; the browser's own pages are left out."""
    command = [chromium(), *FLAGS, *flags, f"--user-data-dir={page.parent / 'profile'}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line and "chrome://" not in line]
