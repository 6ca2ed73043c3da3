"""Two effects at once that a robot may well have, and that the design can tell from one another."""

from __future__ import annotations

PAIRS: tuple[tuple[str, str], ...] = (
    ("thermal_radius_drift", "wheel_eccentricity"),
    ("heading_drift", "floor_drift"),
    ("reference_time_offset", "speed_dependent_radius"),
    ("quadratic_rotation_slip", "direction_dependent_radius"),
    ("acceleration_slip", "thermal_radius_drift"),
    ("coulomb_creep", "heading_drift"),
    ("body_velocity_bias", "centripetal_slip"),
    ("start_transient", "rotation_translation_coupling"),
    ("wheel_dead_zone", "floor_drift"),
    ("load_transfer", "thermal_radius_drift"),
    ("heading_latency", "wheel_eccentricity"),
    ("tyre_wear", "heading_drift"),
    ("rotation_translation_coupling", "body_velocity_bias"),
    ("direction_dependent_radius", "reference_time_offset"),
    ("wheel_eccentricity", "quadratic_rotation_slip"),
)
