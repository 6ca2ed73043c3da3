"""Traces that the figures of a recording share: colours, paths, points, and coordinates rounded for the screen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import LegendItem
from omnibench.report.style import INK, PALETTE, REFERENCE, THEORETICAL, text
from omnibench.robot.kinematics import Array

SCANS, TRUTH, COVARIANCE, PLAN = "#7c8894", INK, PALETTE[0], "#b8977e"

REFERENCE_ITEM = LegendItem("reference", "reference poses", REFERENCE)
ODOMETRY_ITEM = LegendItem("odometry", "odometry by the design values", THEORETICAL, "dash")
TRUTH_ITEM = LegendItem("truth", "true path", TRUTH, "dot")
SCANS_ITEM = LegendItem("scans", "scan points", SCANS)
PLAN_ITEM = LegendItem("plan", "floor plan (truth)", PLAN)
COVARIANCE_ITEM = LegendItem("covariance", "covariance", COVARIANCE)


def path_line(item: LegendItem, poses: Array, width: float, **changes: Any) -> go.Scatter:
    """A trace of a path over the ground; poses (K, 2 or 3), m."""
    style: dict[str, Any] = {
        "x": short(poses[:, 0]),
        "y": short(poses[:, 1]),
        "mode": "lines",
        "line": {"color": item.colour, "width": width, "dash": item.dash},
        "legendgroup": item.key,
        "hovertemplate": f"{text(item.label)}<br>x %{{x:.3f}} m, y %{{y:.3f}} m<extra></extra>",
    }
    return go.Scatter(style | changes)


def scatter(item: LegendItem, points: Array, size: float, **changes: Any) -> go.Scatter:
    """A trace of points (n, 2), m."""
    style: dict[str, Any] = {
        "x": short(points[:, 0], 3),
        "y": short(points[:, 1], 3),
        "mode": "markers",
        "marker": {"color": item.colour, "size": size},
        "legendgroup": item.key,
        "hoverinfo": "skip",
    }
    return go.Scatter(style | changes)


def joined(paths: Sequence[Array]) -> Array:
    """Paths (K, n) joined into one array, with a row of NaN between them, at which a plotted line breaks."""
    if not paths:
        return np.empty((0, 2))
    gap = np.full((1, paths[0].shape[1]), np.nan)
    return np.vstack([part for path in paths for part in (path, gap)][:-1])


def short(values: Array, decimals: int = 4) -> list[float | None]:
    """Values rounded to ``decimals`` decimals; NaN becomes None, at which a plotted line breaks."""
    return [None if value != value else value for value in np.round(values, decimals).tolist()]
