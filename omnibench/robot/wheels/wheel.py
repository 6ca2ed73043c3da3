"""Wheels of a robot as designed: omni, mecanum, fixed and steered ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

from pydantic import (
    ConfigDict,
    Field,
    FiniteFloat,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from omnibench.config import Model, Name

WheelType = Literal["omni", "mecanum", "fixed", "steered"]

_FORWARD = 0.0  # rad, the direction of rolling where none is given
_FARTHEST = 1e3  # m
_ON_AN_AXIS = 1e-9  # m2: a wheel ahead of the centre, or beside it, may have its rollers either way


def in_radians(content: Any, *keys: str) -> Any:
    """A mapping in which each of some angles, rad, may stand in degrees under its key with ``_deg`` at the end."""
    if not isinstance(content, dict):
        return content
    content = dict(content)
    for key in keys:
        degrees = f"{key}_deg"
        if degrees not in content:
            continue
        if key in content:
            raise ValueError(f"{key} and {degrees} are both given; keep one")
        if isinstance(content[degrees], bool) or not isinstance(content[degrees], int | float):
            raise ValueError(f"{degrees} must be a number (given: {content[degrees]!r})")
        content[key] = math.radians(content.pop(degrees))
    return content


def _with_usual_rollers(content: Any) -> Any:
    """A mecanum wheel by x and y with the rollers that it usually has, where none are given.

    Four such wheels show an X from above: the lever arm of each is ``abs(x) + abs(y)`` where it rolls forward.
    """
    if not isinstance(content, dict) or content.get("type") != "mecanum" or content.get("roller_angle") is not None:
        return content
    place = [content.get(key) for key in ("x", "y", "angle")]
    x, y, axle = (value if isinstance(value, int | float) else None for value in place)
    if x is None or y is None:
        return content
    rolling = _FORWARD if axle is None else axle + math.pi / 2
    ahead, left = x * math.cos(rolling) + y * math.sin(rolling), y * math.cos(rolling) - x * math.sin(rolling)
    if abs(ahead * left) < _ON_AN_AXIS:
        return content
    return content | {"roller_angle": math.copysign(math.pi / 4, ahead * left)}


def looks_like_radians(angle: float | None) -> float | None:
    """The angle, rad. ValueError: no angle is that large."""
    if angle is not None and abs(angle) > 4 * math.pi:
        raise ValueError(f"{angle:g} cannot be an angle in rad; is it in degrees?")
    return angle


def in_degrees_too(*keys: str) -> Callable[[dict[str, Any]], None]:
    """Adds to a model's JSON schema the keys that ``in_radians`` takes."""

    def add(schema: dict[str, Any]) -> None:
        schema["properties"] |= {f"{key}_deg": {"type": "number", "description": f"{key} in degrees"} for key in keys}

    return add


class Wheel(Model):
    """Design values of one wheel, in the robot's frame (x forward, y left).

    The place of an omni or mecanum wheel is given as in Fig. 2 of Palacin et al. 2023 by ``distance``, the lever arm
    of its driving force about the centre, and ``angle``, the direction of its axle: for an omni wheel whose axle points
    at the centre its position in polar coordinates; for a mecanum wheel at (lx, ly) with rollers at 45 degrees and its
    axle along y +pi/2 (left) or -pi/2 (right), and ``abs(lx) + abs(ly)``. Or by x, y and the axle's angle.
    By x and y a mecanum wheel has the rollers of the usual arrangement, an X from above, unless it says others.
    A fixed wheel has x, y and, as ``angle``, the direction in which it rolls; a steered one x and y.
    driven: False for a steered wheel whose rate is not measured. measured: False for a wheel that only guides.
    """

    model_config = ConfigDict(json_schema_extra=in_degrees_too("angle", "roller_angle"))

    name: Name = Field(min_length=1, pattern=r"^[A-Za-z0-9_]+$", description="ends the column names: omega_<name>")
    radius: FiniteFloat = Field(ge=1e-6, le=1e3, description="m")
    type: WheelType | None = Field(None, description="default: omni or mecanum, by the roller angle")
    distance: FiniteFloat | None = Field(
        None, ge=1e-6, le=_FARTHEST, description="lever arm about the robot's centre, m"
    )
    angle: FiniteFloat | None = Field(
        None, description="direction of the axle (omni, mecanum) or of rolling (fixed, default 0), rad"
    )
    x: FiniteFloat | None = Field(None, ge=-_FARTHEST, le=_FARTHEST, description="in front of the robot's centre, m")
    y: FiniteFloat | None = Field(None, ge=-_FARTHEST, le=_FARTHEST, description="to the left of the centre, m")
    roller_angle: FiniteFloat = Field(0.0, gt=-1.5, lt=1.5, description="0 omni, +-pi/4 mecanum; rad")
    driven: bool = Field(True, description="steered wheels: false if only the steering angle is measured")
    measured: bool = Field(True, description="false for a wheel that only guides or rolls along")

    @model_validator(mode="before")
    @classmethod
    def _angles_in_radians(cls, content: Any) -> Any:
        return _with_usual_rollers(in_radians(content, "angle", "roller_angle"))

    @field_validator("angle")
    @classmethod
    def _looks_like_radians(cls, angle: float | None) -> float | None:
        return looks_like_radians(angle)

    @model_validator(mode="after")
    def _is_placed(self) -> Wheel:
        if self.kind in ("fixed", "steered"):
            self._stands_at_x_y()
        elif self.distance is None and (self.x is None or self.y is None):
            missing = "distance" if self.x is None and self.y is None else "x" if self.x is None else "y"
            raise ValueError(f"{missing} is missing; give distance and angle (of the axle), or x, y and angle")
        elif self.distance is not None and (self.x is not None or self.y is not None):
            raise ValueError("distance and x, y are both given; keep one")
        elif self.angle is None and (self.kind == "omni" or self.distance is not None):
            raise ValueError("angle (of the axle) is missing")
        if self.type in ("fixed", "steered") and self.roller_angle:
            raise ValueError(f"a {self.type} wheel has no rollers; leave roller_angle out, or is it a mecanum wheel?")
        if self.type == "mecanum" and not self.roller_angle:
            raise ValueError("roller_angle of a mecanum wheel is missing: +-pi/4, or roller_angle_deg: +-45")
        return self

    def _stands_at_x_y(self) -> None:
        if self.distance is not None:
            raise ValueError(f"a {self.type} wheel has x and y in the place of distance")
        for key in ("x", "y"):
            if getattr(self, key) is None:
                raise ValueError(f"{key} of a {self.type} wheel is missing (m, x forward, y left)")
        if self.type == "steered" and self.angle is not None:
            raise ValueError("a steered wheel has no angle: its steering angle is 0 where it rolls forward")

    @model_serializer(mode="wrap")
    def _without_defaults(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only what is said, so that files, hashes and documents of omni wheels stay as they were."""
        plain: dict[str, Any] = {
            "type": None,
            "distance": None,
            "angle": None,
            "x": None,
            "y": None,
            "driven": True,
            "measured": True,
        }
        if self.type in ("fixed", "steered"):
            plain["roller_angle"] = 0.0
        written: dict[str, Any] = write(self)
        return {key: value for key, value in written.items() if key not in plain or value != plain[key]}

    @property
    def kind(self) -> WheelType:
        """The type, of a wheel without one by its rollers."""
        return self.type or ("mecanum" if self.roller_angle else "omni")

    @property
    def has_rate(self) -> bool:
        """True if its rate is measured."""
        return self.measured and (self.kind != "steered" or self.driven)

    @property
    def has_steering(self) -> bool:
        """True if its steering angle is measured."""
        return self.measured and self.kind == "steered"

    @property
    def rolling(self) -> float:
        """Direction in which a positive rate drives the robot over this wheel, rad; of a steered one at angle 0."""
        if self.kind in ("fixed", "steered") or self.angle is None:
            return self.angle or _FORWARD
        return self.angle + math.pi / 2

    @property
    def axle(self) -> float:
        """Direction of the axle, rad, a quarter turn clockwise from that of rolling."""
        if self.kind in ("omni", "mecanum") and self.angle is not None:
            return self.angle
        return self.rolling - math.pi / 2

    @property
    def position(self) -> tuple[float, float]:
        """Position x, y, m; of a wheel given by its lever arm on the line of its axle."""
        if self.x is not None and self.y is not None:
            return self.x, self.y
        assert self.distance is not None  # it is placed
        assert self.angle is not None
        return self.distance * math.cos(self.angle), self.distance * math.sin(self.angle)

    @property
    def lever(self) -> float:
        """Lever arm of the driving force about the robot's centre, m; above 0 where it turns counter-clockwise."""
        if self.distance is not None:
            return self.distance
        x, y = self.position
        cosine, sine = math.cos(self.rolling), math.sin(self.rolling)
        return x * sine - y * cosine - math.tan(self.roller_angle) * (x * cosine + y * sine)

    @property
    def outward(self) -> float:
        """Direction of the wheel as seen from the robot's centre, rad; where only a lever arm is given, of its axle."""
        if self.distance is not None and self.angle is not None:
            return self.angle
        x, y = self.position
        return math.atan2(y, x)

    @property
    def reach(self) -> float:
        """Distance from the robot's centre as what counts when it turns, m: the lever arm where that is given."""
        return self.distance if self.distance is not None else math.hypot(*self.position)
