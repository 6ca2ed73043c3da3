"""Results of runs on disk, one file a run, so that a comparison can be continued."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnibench.config import Model
from omnibench.files import write_text
from omnibench.fit.calibrator import Outcome, RunResult
from omnibench.fit.problem import Improvement
from omnibench.robot.calibration import Noise, matrix_rows
from omnibench.robot.kinematics import Array


class StoredRun(Model):
    """Content of a run's file."""

    outcome: Outcome
    reason: str
    vector: tuple[float, ...] | None
    matrix: tuple[tuple[float, ...], ...] | None
    cost: float | None
    evaluations: int
    seconds: float
    history: tuple[tuple[int, float, float], ...]
    at_bounds: tuple[str, ...]
    held: tuple[str, ...]
    covariance: tuple[tuple[float, ...], ...] | None = None
    noise: Noise | None = None
    degrees_of_freedom: int | None = None

    @classmethod
    def of(cls, result: RunResult) -> StoredRun:
        """The content for a result."""
        return cls(
            outcome=result.outcome,
            reason=result.reason,
            vector=None if result.vector is None else tuple(result.vector.tolist()),
            matrix=None if result.matrix is None else matrix_rows(result.matrix),
            cost=result.cost,
            evaluations=result.evaluations,
            seconds=result.seconds,
            history=tuple((step.evaluations, step.seconds, step.cost) for step in result.history),
            at_bounds=result.at_bounds,
            held=result.held,
            covariance=None if result.covariance is None else tuple(map(tuple, result.covariance.tolist())),
            noise=result.noise,
            degrees_of_freedom=result.degrees_of_freedom,
        )

    def result(self) -> RunResult:
        """The result that was stored."""
        return RunResult(
            outcome=self.outcome,
            reason=self.reason,
            vector=_array(self.vector),
            matrix=_array(self.matrix),
            cost=self.cost,
            evaluations=self.evaluations,
            seconds=self.seconds,
            history=tuple(Improvement(*row) for row in self.history),
            at_bounds=self.at_bounds,
            held=self.held,
            covariance=_array(self.covariance),
            noise=self.noise,
            degrees_of_freedom=self.degrees_of_freedom,
        )


class RunStore:
    """Results of runs by key, each in a JSON file in ``folder``. DataError when one cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, key: str) -> RunResult | None:
        """The stored result; None where there is none, or its file is damaged."""
        try:
            return StoredRun.model_validate_json(self._file(key).read_text(encoding="utf-8")).result()
        except (OSError, ValueError):  # ValueError: pydantic's and Unicode's errors, too
            return None

    def put(self, key: str, result: RunResult) -> None:
        """Store a result."""
        write_text(self._file(key), StoredRun.of(result).model_dump_json(indent=1))

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.json"


def _array(values: tuple[float, ...] | tuple[tuple[float, ...], ...] | None) -> Array | None:
    return None if values is None else np.array(values, dtype=float)
