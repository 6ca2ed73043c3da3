"""The effects of the catalogue that are hidden, by their names, with the sizes that are plausible."""

from __future__ import annotations

from . import body_forms as body
from . import third_forms as third
from . import wheel_forms as wheel
from .form import Form, wheelwise

SESSIONS = {"radius_s2": 0.01, "radius_s3": 0.01, "radius_s4": 0.01}  # of the design "sessions"
LENGTHS = (0.05, 0.1, 0.2)  # m
ROLLERS = tuple(range(3, 13))

FORMS: dict[str, Form] = {
    "speed_dependent_radius": Form(
        wheel.speed_dependent, wheel.speed_dependent_saturating, third.speed_dependent_power, {"k": 0.02}
    ),
    "direction_dependent_radius": Form(
        wheel.direction_dependent,
        wheel.direction_dependent_soft,
        third.direction_dependent_threshold,
        wheelwise("k", 0.01),
    ),
    "wheel_dead_zone": Form(
        wheel.dead_zone, wheel.dead_zone_soft_knee, third.dead_zone_stribeck, {"c": 0.02}, designs=("rich",)
    ),
    "coulomb_creep": Form(wheel.creep, wheel.creep_saturating, third.creep_power, {"c": 0.02}, designs=("rich",)),
    "wheel_eccentricity": Form(
        wheel.eccentricity,
        wheel.eccentricity_of_two_harmonics,
        third.eccentricity_of_a_bulge,
        wheelwise("a", 0.02) | wheelwise("b", 0.02),
    ),
    "roller_ripple": Form(
        wheel.ripple,
        wheel.ripple_with_edges,
        third.ripple_of_unequal_rollers,
        wheelwise("a", 0.03) | wheelwise("b", 0.03),
        designs=("precise",),
        shapes={"rollers": ROLLERS},
    ),
    "thermal_radius_drift": Form(wheel.thermal, wheel.thermal_exponential, third.thermal_of_two_constants, {"k": 2e-5}),
    "tyre_wear": Form(wheel.wear, wheel.wear_uneven, third.wear_running_in, SESSIONS, designs=("sessions",)),
    "acceleration_slip": Form(
        body.acceleration_slip,
        body.acceleration_slip_saturating,
        third.acceleration_slip_of_driving_and_braking,
        {"k": 0.1},
        one_sided=True,
    ),
    "centripetal_slip": Form(
        body.centripetal_slip,
        body.centripetal_slip_saturating,
        third.centripetal_slip_of_two_axes,
        {"k": 0.1},
        one_sided=True,
    ),
    "rotation_translation_coupling": Form(
        body.coupling, body.coupling_saturating, third.coupling_of_three_sides, {"kx": 0.3, "ky": 0.3}
    ),
    "load_transfer": Form(
        wheel.load_transfer, wheel.load_transfer_saturating, third.load_transfer_with_a_stop, {"k": 0.3}, one_sided=True
    ),
    "quadratic_rotation_slip": Form(
        body.rotation_slip,
        body.rotation_slip_saturating,
        third.rotation_slip_threshold,
        {"k": 0.1},
        designs=("rich",),
        one_sided=True,
    ),
    "heading_drift": Form(
        body.heading_drift, body.heading_drift_that_varies, third.heading_drift_that_settles, {"b": 0.005}
    ),
    "body_velocity_bias": Form(
        body.velocity_bias, body.velocity_bias_that_varies, third.velocity_bias_by_activity, {"bx": 0.005, "by": 0.005}
    ),
    "start_transient": Form(
        body.transient,
        body.transient_linear,
        third.transient_with_a_tail,
        {"k": 0.2},
        one_sided=True,
        shapes={"length": LENGTHS},
    ),
    "floor_drift": Form(body.floor_drift, body.floor_drift_uneven, third.floor_drift_of_pile, {"dx": 0.02, "dy": 0.02}),
    "reference_time_offset": Form(
        body.time_offset, body.time_offset_with_jitter, third.time_offset_under_load, {"tau": 0.2}
    ),
    "heading_latency": Form(
        body.heading_latency, body.heading_latency_with_jitter, third.heading_latency_of_two_states, {"tau": 0.1}
    ),
}
