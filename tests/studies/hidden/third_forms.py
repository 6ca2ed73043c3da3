"""Third forms of the catalogue's effects, by another author than the catalogue's and the blind forms'.

Each has the cause and the covariate of its effect and comes near the catalogue's form in the mean, but follows another
law. The ranges of the shape constants are chosen from physics and from the design's speeds alone (0.1 to 0.3 m/s, up to
0.9 rad/s, ramps of 0.3 s), before any discovery: 3 to 30 % of the whitened signature, in the median, is out of the
catalogue form's reach (``form_shares.py``). They are not to be tuned on.
"""

from __future__ import annotations

import numpy as np
from scipy.special import i0, i1

from omnibench.robot.kinematics import Array

from .experiment import RAMP, ROBOT
from .form import WHEELS, Values, of_wheels
from .motion import Correction, Grid

SPEED, TURN, RATE, ACCELERATION = 0.2, 0.5, 1.35, 0.7  # m/s, rad/s, rad/s of a wheel, m/s2: in the middle of the design


def speed_dependent_power(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Tyres that grow by a power of the rate, not alike: r(1 + k rate0 |rate/rate0|^p)."""
    power, unequal = _power(rng), _unequal(rng, 0.2)
    growth = values["k"] * RATE * np.abs(grid.rates / RATE) ** power
    return Correction(wheel=unequal * growth * grid.rates)


def direction_dependent_threshold(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Treads that lean only under drag: rate + k_i max(|rate| - threshold, 0)."""
    threshold = rng.uniform(0.35, 0.65)  # rad/s
    leaning = np.maximum(np.abs(grid.rates) - threshold, 0.0)
    return Correction(wheel=of_wheels(values, "k") * leaning)


def dead_zone_stribeck(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Friction that falls from breakaway to sliding: c sign(rate) (f + (1 - f) exp(-(rate/rate_s)^2)), by wheel."""
    sliding, knee, unequal = rng.uniform(0.5, 0.75), rng.uniform(0.5, 1.2), _unequal(rng)  # -, rad/s
    friction = sliding + (1 - sliding) * np.exp(-((grid.rates / knee) ** 2))
    return Correction(wheel=values["c"] * unequal * friction * np.sign(grid.rates))


def creep_power(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Creep that grows by a power of the speed, not alike at all wheels: c sign(rate) v0/r (|v|/v0)^p."""
    power, unequal = _power(rng), _unequal(rng)
    creep = values["c"] * SPEED / ROBOT.wheels[0].radius * (grid.speed / SPEED) ** power
    return Correction(wheel=creep[:, None] * unequal * np.sign(grid.rates))


def eccentricity_of_a_bulge(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """One bulge a turn, narrower than a cosine: exp(kappa cos(phi - phi0)), less its mean."""
    kappa = rng.uniform(1.0, 1.8)
    across, along = of_wheels(values, "b"), of_wheels(values, "a")
    size, top = np.hypot(along, across), np.arctan2(across, along)
    bulge = (np.exp(kappa * np.cos(grid.angles - top)) - i0(kappa)) / (2 * i1(kappa))  # its first harmonic is 1
    return Correction(wheel=size * bulge * grid.rates)


def ripple_of_unequal_rollers(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Rollers worn more on one side of the wheel, and rounded: sidebands at n +- 1, and twice n."""
    worn, rounded, sides = rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.25), rng.uniform(-np.pi, np.pi, len(WHEELS))
    across, along = of_wheels(values, "b"), of_wheels(values, "a")
    size, top = np.hypot(along, across), np.arctan2(across, along)
    phase = values["rollers"] * grid.angles - top
    profile = np.cos(phase) * (1 + worn * np.cos(grid.angles - sides)) + rounded * np.cos(2 * phase)
    return Correction(wheel=size * profile * grid.rates)


def thermal_of_two_constants(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A tread that warms in minutes on a core that warms in hours, not alike: slope k at the session's start."""
    share, unequal = rng.uniform(0.25, 0.5), _unequal(rng)
    quick, slow = rng.uniform(300, 700), rng.uniform(4000, 10000)  # s
    time = grid.session_time
    warmth = share * quick * (1 - np.exp(-time / quick)) + (1 - share) * slow * (1 - np.exp(-time / slow))
    return Correction(wheel=values["k"] * warmth[:, None] * unequal * grid.rates)


def wear_running_in(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Tyres that reach a session's radius only in its course, from that of the session before, and not alike."""
    constant, unequal = rng.uniform(60, 200), _unequal(rng)  # s
    now = np.array([values.get(f"radius_{run.session}", 0.0) for run in grid.runs])
    before = np.array([values.get(f"radius_s{run.session_number - 1}", 0.0) for run in grid.runs])
    left = np.exp(-grid.session_time / constant)
    radius = grid.of_run(now) + grid.of_run(before - now) * left
    return Correction(wheel=radius[:, None] * unequal * grid.rates)


def acceleration_slip_of_driving_and_braking(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Slip by a power of the acceleration, another when braking than when driving, built up over a relaxation time."""
    power, braking, constant = _power(rng), rng.uniform(0.75, 0.9), rng.uniform(0.04, 0.12)  # -, -, s
    driving = _relaxed_ramps(grid, constant)
    acceleration = _peaks(grid) * driving[:, None]
    gain = values["k"] * _beside_linear(acceleration, ACCELERATION, power) * np.where(driving < 0, braking, 1.0)
    return _body(translation=-gain[:, None] * acceleration)


def centripetal_slip_of_two_axes(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Slip by a power of w x v, stiffer along one axis of the robot than across it."""
    power, stretch = _power(rng), _stretch(rng)
    gain = values["k"] * _beside_linear(grid.centripetal, TURN * SPEED, power)
    return _body(translation=gain[:, None] * grid.centripetal @ stretch)


def coupling_of_three_sides(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Coupling by a power of the speed, that three wheels feel more in some directions: 1 + m cos(3 direction)."""
    power, sides, side = _power(rng), rng.uniform(0.2, 0.45), rng.uniform(-np.pi, np.pi)
    vx, vy, w = grid.twist.T
    direction = np.arctan2(vy, vx)
    speed = SPEED * (grid.speed / SPEED) ** power * (1 + sides * np.cos(3 * direction - side))
    along = values["kx"] * np.cos(direction) + values["ky"] * np.sin(direction)
    return _body(rotation=w * along * speed)


def load_transfer_with_a_stop(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A body that leans once friction is overcome, with a delay, and no further than a stop."""
    stop, friction, constant = (
        rng.uniform(0.35, 0.55),
        rng.uniform(0.015, 0.03),
        rng.uniform(0.06, 0.15),
    )  # m/s2, m/s2, s
    lean = _peaks(grid) * _relaxed_ramps(grid, constant)[:, None] + grid.centripetal
    towards = np.array([[np.cos(wheel.angle), np.sin(wheel.angle)] for wheel in ROBOT.wheels])
    load = lean @ towards.T
    load = np.sign(load) * np.clip(np.abs(load) - friction, 0.0, stop)
    return Correction(wheel=-values["k"] * load * grid.rates)


def rotation_slip_threshold(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Scrubbing that begins above a rate of turn, and is stronger to one side."""
    threshold, stronger = rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.25) * rng.choice([-1.0, 1.0])  # rad/s, -
    w = grid.twist[:, 2]
    scrub = np.maximum(np.abs(w) - threshold, 0.0) * w * (1 + stronger * np.sign(w))
    return _body(rotation=-values["k"] * scrub)


def heading_drift_that_settles(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A drift that starts stronger, in every run and in the session, and settles: two constants of time."""
    jump, constant = rng.uniform(0.8, 1.6), rng.uniform(1.0, 3.0)  # -, s
    warming, session = rng.uniform(0.3, 0.8), rng.uniform(500, 1500)  # -, s
    course = 1 + jump * np.exp(-grid.elapsed / constant) + warming * np.exp(-grid.session_time / session)
    return _body(rotation=values["b"] * course)


def velocity_bias_by_activity(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A pull of turning rollers: it grows to its full size with the wheels' rates, and in the course of a run."""
    knee, missing, constant = rng.uniform(0.4, 0.9), rng.uniform(0.6, 0.85), rng.uniform(1.0, 3.0)  # rad/s, -, s
    activity = 1 - np.exp(-np.sqrt((grid.rates**2).mean(axis=1)) / knee)
    course = activity * (1 - missing * np.exp(-grid.elapsed / constant))
    return _body(translation=np.outer(course, [values["bx"], values["by"]]))


def transient_with_a_tail(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A transient with a longer tail than an exponential, (1 + s / (q length))^-q, of another size on either axis."""
    exponent, stretch = rng.uniform(1.5, 3.0), _stretch(rng)
    share = (1 + grid.travelled / (exponent * values["length"])) ** -exponent
    return _body(translation=-values["k"] * share[:, None] * grid.twist[:, :2] @ stretch)


def floor_drift_of_pile(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A pile that pushes more where it is driven against, by a power of the speed: d |v| (1 - m cos(direction))."""
    power, against = _power(rng), rng.uniform(0.2, 0.5)
    vx, vy, _ = grid.twist.T
    pile = np.array([values["dx"], values["dy"]])
    direction = grid.heading + np.arctan2(vy, vx) - np.arctan2(pile[1], pile[0])
    push = SPEED * (grid.speed / SPEED) ** power * (1 - against * np.cos(direction))
    return Correction(world=np.outer(push, pile))


def time_offset_under_load(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A latency that follows a computer's load in the course of a session, and jitters."""
    swing, period, phase = rng.uniform(0.25, 0.5), rng.uniform(500, 1500), rng.uniform(-np.pi, np.pi)  # -, s, rad
    jitter = 0.1 * values["tau"] * rng.standard_normal(len(grid.stamps))
    started = np.array([run.started_at for run in grid.runs])[grid.stamp_run]
    load = 1 + swing * np.sin(2 * np.pi * (started + grid.stamps) / period + phase)
    return Correction(delay=values["tau"] * load, chance=Correction(delay=jitter))


def heading_latency_of_two_states(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A latency of either of two buffer lengths, from run to run, that changes by a power of the rate of turn."""
    apart, power = rng.uniform(0.15, 0.4), _power(rng)
    states = 1 + apart * np.where(rng.random(len(grid.runs)) < 0.5, -1.0, 1.0)
    turns = np.array([abs(run.command.turn) for run in grid.runs])
    delay = values["tau"] * states * np.maximum(turns / TURN, 0.1) ** (power - 1)
    return Correction(heading_delay=delay[grid.stamp_run])


def _power(rng: np.random.Generator) -> float:
    """An exponent beside 1, below or above it."""
    return float(rng.choice([rng.uniform(0.7, 0.85), rng.uniform(1.2, 1.4)]))


def _unequal(rng: np.random.Generator, least: float = 0.1) -> Array:
    """Factors (N,) of the wheels about 1; that of one is off by a share between this and 30 %."""
    pattern = rng.standard_normal(len(WHEELS))
    pattern -= pattern.mean()
    return 1 + rng.uniform(least, 0.3) * pattern / np.abs(pattern).max()


def _stretch(rng: np.random.Generator) -> Array:
    """A symmetric matrix (2, 2) that is 1.15 to 1.35 along some axis of the robot and 0.85 to 0.65 across it."""
    uneven, axis = rng.uniform(0.15, 0.35), rng.uniform(0, np.pi)
    cosine, sine = np.cos(2 * axis), np.sin(2 * axis)
    return np.eye(2) + uneven * np.array([[cosine, sine], [sine, -cosine]])


def _beside_linear(vectors: Array, size: float, power: float) -> Array:
    """What a power of vectors (n, 2) gives beyond their first power (n,): 1 where they have this size."""
    return np.maximum(np.hypot(*vectors.T) / size, 1e-3) ** (power - 1)


def _peaks(grid: Grid) -> Array:
    """The acceleration (n, 2) of the ramp at a run's start, at all its steps, m/s2."""
    return grid.of_run(grid.acceleration[grid.first[:-1]])


def _relaxed_ramps(grid: Grid, constant: float) -> Array:
    """Both ramps (n,), 1 and -1, behind a first-order lag of this time constant (s)."""

    def step(since: Array) -> Array:
        return -np.expm1(-np.maximum(since, 0.0) / constant)

    left = grid.ends[grid.run] - grid.elapsed
    return step(grid.elapsed) - step(grid.elapsed - RAMP) - step(RAMP - left)


def _body(translation: Array | None = None, rotation: Array | None = None) -> Correction:
    """A correction of the velocity (n, 2), m/s, or the rate of turn (n,), rad/s."""
    known = rotation if translation is None else translation[:, 0]
    assert known is not None
    body = np.zeros((len(known), 3))
    if translation is not None:
        body[:, :2] = translation
    if rotation is not None:
        body[:, 2] = rotation
    return Correction(body=body)
