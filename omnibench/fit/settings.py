"""Settings of a fit: every choice, from the command line to the provenance in the calibration file.

This file imports no more than the choices' types, since the options of ``omnibench calibrate`` are made from it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from omnibench.config import Model, Positive
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.loss import LossName
from omnibench.fit.parameterisation import Box, ParameterisationName
from omnibench.fit.prior import MountChoice
from omnibench.fit.span import Treatment, Unidentified
from omnibench.robot.odometry import Integration

SteeringChoice = Literal["known", "fit"]


class Budget(Model):
    """Limits of one run of a calibrator."""

    evaluations: int = Field(60_000, gt=0, description="Budget: most evaluations of the cost.")
    seconds: float = Field(600.0, gt=0, description="Budget: longest time, in s.")


class CostChoice(Model):
    """The cost that every calibrator minimises."""

    name: str = Field("final_pose", description="a cost, see omnibench list")
    options: dict[str, Any] = {}


class FitSettings(Model):
    """Every choice of a fit. ``calibrate`` fills fields that are None with defaults for the robot and its runs.

    The fields are the options of ``omnibench calibrate``, with their descriptions.
    """

    calibrator: str | None = Field(
        None,
        description="How to fit; omnibench list names all. Default: map, the most probable model given the references "
        "and the design.",
    )
    options: dict[str, Any] = Field({}, description="Options of the calibrator.")
    cost: CostChoice | None = Field(
        None, description="What to minimise (see omnibench list). Default: final_pose; trajectory, of few runs."
    )
    loss: LossName = Field(
        "squares", description="huber, student_t: bound the influence of reference poses that are far off."
    )
    parameterisation: ParameterisationName | None = Field(
        None, description="Search the matrix elements, or the wheels' geometry. Default: the calibrator's own."
    )
    box: Box = Field(
        "row", description="Search range. paper: +-10 % of each element; row: +-25 % of the row's largest element."
    )
    limits: GeometryLimits | None = Field(None, description="Limits of the wheels' geometry.")
    integration: Integration = Field(
        "arc", description="Path within a sample. arc: exact for constant rates; euler: the paper's straight step."
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(1, description="Seed of the random numbers.")
    budget: Budget = Budget()
    intervals: bool = Field(
        False, description="Has no effect any more: 95 % intervals are always stated where the data have them."
    )
    unidentified: Unidentified | None = Field(
        None,
        description="What the data hardly tell, of calibrators that do not weigh the design as map does: keep the "
        "design where motions are hardly driven (default), or fit it all the same.",
    )
    tolerance: Positive | None = Field(
        None, description="Of the design, for map: share of each row's largest element. Default: by class."
    )
    mount: MountChoice | None = Field(
        None,
        description="fit: where the tracked point stands. Default: for tricycles and cars, by map where robots slide.",
    )
    steering: SteeringChoice = Field(
        "known", description="fit: also find its gain, play and coupling, or a car's zero."
    )

    @field_validator("cost", mode="before", json_schema_input_type=str | CostChoice | None)
    @classmethod
    def _name_stands_for_cost(cls, cost: Any) -> Any:
        return {"name": cost} if isinstance(cost, str) else cost


class CompleteSettings(FitSettings):
    """Settings of a fit that name its calibrator, cost, parameterisation and treatment of unidentified motions."""

    calibrator: str
    cost: CostChoice
    parameterisation: ParameterisationName
    unidentified: Treatment  # type: ignore[assignment]

    @property
    def objective(self) -> str:
        """The cost and its loss in words."""
        return objective_in_words(self.cost, self.loss)

    @property
    def provenance(self) -> dict[str, Any]:
        """The fields of a calibration file's provenance that are choices alone."""
        loss = None if self.loss == "squares" else self.loss
        names = {"calibrator": self.calibrator, "options": self.options, "seed": self.seed}
        return names | {"cost": self.cost.name, "loss": loss}


def objective_in_words(cost: CostChoice, loss: LossName) -> str:
    """The names of a cost and of its loss, if that is a robust one."""
    return cost.name if loss == "squares" else f"{cost.name}, loss {loss}"
