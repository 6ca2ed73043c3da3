"""Items of the legend that the figures of a recording share."""

from __future__ import annotations

from omnibench.report.blocks import LegendItem
from omnibench.report.style import INK, PALETTE, REFERENCE, THEORETICAL

SCANS, TRUTH, COVARIANCE, PLAN = "#7c8894", INK, PALETTE[0], "#b8977e"

REFERENCE_ITEM = LegendItem("reference", "reference poses", REFERENCE)
ODOMETRY_ITEM = LegendItem("odometry", "odometry by the design values", THEORETICAL, "dash")
TRUTH_ITEM = LegendItem("truth", "true path", TRUTH, "dot")
SCANS_ITEM = LegendItem("scans", "scan points", SCANS)
PLAN_ITEM = LegendItem("plan", "floor plan (truth)", PLAN)
COVARIANCE_ITEM = LegendItem("covariance", "covariance", COVARIANCE)
