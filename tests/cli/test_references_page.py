"""The example of the handbook's page on references runs as it is written."""

from __future__ import annotations

import ast
import re

import numpy as np
import pytest

from omnibench.cli.handbook_topics import find_topic


def test_the_example_of_the_page_on_references_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (program,) = re.findall(r"```python\n(.*?)```", find_topic("references").text, re.DOTALL)
    exec(compile(program, "references.md", "exec"), {})  # noqa: S102 (a program of the handbook)
    matrix = np.array(ast.literal_eval(capsys.readouterr().out))
    assert matrix[0] @ [6.0, 6.0] * 10 == pytest.approx(3.03, abs=0.01)
    assert matrix[2] @ [-3.0, 3.0] * 10 == pytest.approx(9.7, abs=0.05)
