"""A certificate as it is shown: the cost of a calibration beside what no matrix of the box can undercut."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omnibench.fit.certify import QUADRATURE, CertifiedCalibration
from omnibench.report.blocks import Column, Row, Table
from omnibench.report.result import NextStep, Remark, Result
from omnibench.words import kind_of_data, plural

_NOTHING_TO_GAIN = 0.01  # share of the cost that is not worth another search; chosen


class CertificateResult(Result):
    """A certificate of the calibration in ``file`` on data sets, as they were typed."""

    def __init__(self, certified: CertifiedCalibration, file: Path, sources: Sequence[Path] = ()) -> None:
        self.certified, self.file, self.sources = certified, file, sources
        outside = (
            f"the calibration is outside the box {certified.certificate.box!r}; the bound is for matrices inside it"
        )
        self.warnings = [*certified.dataset.warnings, *([] if certified.inside else [outside])]

    def tables(self) -> Sequence[Table]:
        certified = self.certified
        certificate, proof = certified.certificate, certified.proof
        costs = {"the calibration": certificate.cost * (1 + (certificate.shrinking or 0.0))}
        if certificate.shrinking is not None:
            costs["optimum of the matrix alone"] = certificate.cost
        if proof.best_cost < certificate.cost:
            costs["best matrix seen in the box"] = proof.best_cost
        costs["proven lower bound"] = certificate.lower_bound
        rows = tuple(Row.of(name, f"{cost:.9f}") for name, cost in costs.items())
        name, kind = certified.dataset.name, kind_of_data(certified.dataset.simulated)
        columns = (Column("matrix", numeric=False), Column(f"cost {certified.cost_name}"))
        return [Table(f"{name} ({kind}), training split", columns, rows)]

    def remarks(self) -> Sequence[Remark]:
        certificate, proof = self.certified.certificate, self.certified.proof
        gain = (
            f"No matrix in the box {certificate.box!r} costs less than that: whatever the optimiser, there is at most "
            f"{max(certificate.gap, 0.0):.3%} to gain on this calibration."
        )
        if certificate.cost < QUADRATURE:
            gain = f"There is nothing to gain: what is left is rounding (below {QUADRATURE:g})."
        lines = [gain]
        if certificate.shrinking is not None:
            differs = f"its cost differs by {certificate.shrinking:+.2%}"
            lines.insert(0, f"The calibration weighs the design, or has effects: {differs}.")
        if self.certified.held:
            lines.append(f"The box holds {', '.join(self.certified.held)} at the design value.")
        ended = "" if proof.finished else "; with more (--seconds, --parts) the bound may rise"
        lines.append(f"{plural(proof.boxes, 'part')} of the box examined in {certificate.seconds:.1f} s{ended}")
        return list(map(Remark, lines))

    def next_step(self) -> NextStep:
        gap = max(self.certified.certificate.gap, 0.0)
        if gap <= _NOTHING_TO_GAIN:
            command: tuple[object, ...] = ("omnibench", "discover", *self.sources, "--model", self.file)
            return NextStep(
                f"no search can gain more than {gap:.2%} on {self.file}", "look for what a matrix lacks", command
            )
        saves = f"a better matrix may save up to {gap:.1%} of the cost"
        if not self.certified.proof.finished:
            command = ("omnibench", "certify", self.file, *self.sources, "--seconds", "600")
            return NextStep(saves, "prove more, with more time", command)
        return NextStep(saves, "search for it", ("omnibench", "calibrate", *self.sources, "-o", "better.yaml"))

    def json(self) -> Mapping[str, Any]:
        return self.certified.certificate.model_dump(exclude_none=True)
