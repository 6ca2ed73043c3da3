"""Dask as the backend that is named: mistakes end in one line before any job."""

from __future__ import annotations

import http.server
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from commands import ENVIRONMENT, Command, assert_refused, write_config
from dask_samples import certificates, refusal

from omnibench.errors import ConfigError
from omnibench.jobs.backend_choice import check_backend
from omnibench.jobs.job import TlsFiles


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("dusk", ("'dusk'", "did you mean 'dask'?", "processes, dask, tcp://HOST:PORT, tls://HOST:PORT")),
        ("tcp://127.0.0.1", ("unknown backend 'tcp://127.0.0.1'",)),
        ("tcp://:8786", ("unknown backend 'tcp://:8786'",)),
        ("tls://127.0.0.1:8786", ("--tls-ca, --tls-cert, --tls-key",)),
    ],
)
def test_a_wrong_backend_is_named(name: str, parts: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as refused:
        check_backend(name)
    assert all(part in str(refused.value) for part in parts)


def test_a_scheduler_that_nobody_started_is_one_line(command: Command, tmp_path: Path) -> None:
    run = command("compare", write_config(tmp_path), "-o", tmp_path / "out", "--backend", "tcp://127.0.0.1:9")
    assert_refused(run, "tcp://127.0.0.1:9", "dask scheduler")


def test_without_dask_one_line_names_the_extra(tmp_path: Path) -> None:
    without = "import sys; sys.modules['distributed'] = None; from omnibench.__main__ import main; main()"
    command = [sys.executable, "-c", without, "compare", str(write_config(tmp_path)), "--backend", "dask"]
    run = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert_refused(run, 'pip install "omnibench[dask]"')


def test_dask_is_imported_only_where_it_is_asked_for() -> None:
    program = "import sys, omnibench.compare.run, omnibench.cli.app; print('distributed' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", program], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert run.stdout == "False\n"


def test_a_web_server_is_no_scheduler() -> None:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.SimpleHTTPRequestHandler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    place = f"tcp://127.0.0.1:{server.server_port}"
    try:
        assert refusal(place).startswith(f"no Dask scheduler answers at {place}")
    finally:
        server.shutdown()


def test_a_file_of_tls_that_is_none_is_named(tmp_path: Path) -> None:
    ca, cert, key = certificates(tmp_path)
    text = tmp_path / "text"
    text.write_text("no certificate")
    place = "tls://127.0.0.1:1"
    for files, line in (
        (TlsFiles(ca=text, cert=cert, key=key), f"ca: {text}: "),
        (TlsFiles(ca=ca, cert=cert, key=text), f"cert and key: {cert}, {text}: "),
        (TlsFiles(ca=ca, cert=tmp_path, key=key), f"cert: {tmp_path}: is a folder"),
    ):
        assert refusal(place, tls=files).startswith(f"backend {place}: {line}")
