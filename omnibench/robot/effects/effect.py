"""Effects: named corrections of the odometry model, with their physics and plausible ranges, and forms of them.

In a form of an effect its size varies with a covariate, or from wheel to wheel, where the textbook has it constant.
With c the textbook's correction by a parameter, x a covariate scaled to [-1, 1] over the range that was driven and held
outside, and m_1, m_2 the means of x and x^2 weighted by c^2 (of all parameters), the family of the effect is

    c (b + b_1 (x - m_1) + b_2 (x^2 - m_2)),                                                                       (1)

b, b_1, b_2 being parameters; the textbook's form has b_1 = b_2 = 0, and b is as it would be without these. A slip that
saturates has b_1 of the other sign than b. Where an effect has one parameter for all wheels, each wheel w but the last
has a further b_w, of its difference from the mean of all,

    c_i (b + sum over w of b_w (1 if i = w else -1 if i is the last, 0 for others)).                               (2)

Names of these values hold a colon: ``k:speed:1`` is b_1 of parameter k over the speed, ``speed:low``, ``speed:high``,
``speed:mean_1`` and ``speed:mean_2`` are its scale, ``k:wheel:a`` is b_w of wheel a.
"""

from __future__ import annotations

import base64
import binascii
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal

import numpy as np

from omnibench.errors import DataError, UnknownNameError
from omnibench.registry import Options, effects
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals, needed

Stage = Literal["actuator", "wheel", "steering", "clock", "body", "world", "reference"]
Need = Literal[
    "wheel_angles", "session_time", "session", "targets", "poses", "steering_side", "servo_gaps", "caster_rates"
]
Values = Mapping[str, float]

MOST_BYTES: Final = 48 * 1024  # decoded: with the rest of a calibration they fit in a request to the live node
_NUMBER = np.dtype("<f4")
_SCALES = -1e9, 1e9  # range of the values that scale a form's covariate; chosen
_FAR_OUTSIDE = 1e3  # multiple of the plausible range beyond which a value is refused; chosen

_POWERS = (1, 2)
_LARGEST = 2.0  # plausible size of a form's parameter, times that of the textbook's
_TOP = 0.99  # quantile of a covariate up to which its forms vary, so that no single sample stretches them; chosen
_VARIES = 0.02  # share of its largest value by which a covariate must vary
_BY_SHOWN = {
    "wheel rate": ("wheel rate",),
    "acceleration": ("acceleration",),
    "elapsed time": ("elapsed time", "session time"),
    "order of runs": ("session time",),
    "wheel angle": ("wheel angle",),
    "steering angle": ("steering angle",),
    "heading": ("speed",),
}


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect.

    low, high: plausible range, in ``unit``; a fitted value may lie outside. choices: values to try, for a parameter in
    which the correction is not linear (a number of rollers, a length). The correction is linear in all other parameters
    and vanishes where they are 0.
    """

    name: str
    unit: str
    low: float
    high: float
    description: str
    choices: tuple[float, ...] = ()

    @property
    def largest(self) -> float:
        """The largest plausible size."""
        return max(abs(self.low), abs(self.high))


class Effect(ABC):
    """A term that can be added to the odometry model. Derive from one of the three kinds below.

    stage: where it acts. physics: a sentence on its cause. source: literature. shows_in: the covariate on which the
    residual depends. needs: data that must have been recorded, and signals that are computed only on demand.
    run_nuisance: True if it has one value for each run, which is estimated and reported but is no answer of
    ``discover``. measurement: how to measure it, for an effect that a change of the matrix can absorb. only_for: the
    robots to which it applies, in words, where these are not all; then override ``applies``. form_covariates: with what
    its size may vary (effect.py), by default what follows from shows_in. fixed_parameters: parameters that are the same
    for every robot; otherwise override ``parameters``. in_catalogue: False for a smooth
    function without physics, which ``discover`` never names. weighted: True if it has weights beside its parameters,
    many numbers that only training finds; then override ``with_weights`` and ``trial_weights``.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    physics: ClassVar[str]
    source: ClassVar[str]
    shows_in: ClassVar[str]
    needs: ClassVar[frozenset[Need]] = frozenset()
    run_nuisance: ClassVar[bool] = False
    in_catalogue: ClassVar[bool] = True
    measurement: ClassVar[str] = ""
    only_for: ClassVar[str] = ""
    form_covariates: ClassVar[tuple[str, ...] | None] = None
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = ()
    weighted: ClassVar[bool] = False

    def __init__(self, options: Options | None = None) -> None:
        self.options = options or Options()

    def applies(self, robot: Robot) -> bool:  # noqa: ARG002
        """True for a robot that has what the effect acts on."""
        return True

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        """The parameters for a robot; sessions: names, in order, of the sessions that are fitted."""
        return self.fixed_parameters

    def accepts(self, parameter: str) -> bool:  # noqa: ARG002
        """True for a parameter that ``parameters`` does not list but that is valid: one of an unknown session."""
        return False

    def with_weights(self, weights: Array, robot: Robot, prefix: str) -> Effect:  # noqa: ARG002
        """The effect with weights (n,) for a robot. DataError, which begins with ``prefix``: they do not fit it."""
        return self

    def trial_weights(self, robot: Robot) -> Array:  # noqa: ARG002
        """Some weights (n,) for a robot with which the effect changes something, for tests."""
        return np.empty(0)


class MotionEffect(Effect):
    """An effect of stage wheel, steering, clock, body or world."""

    @abstractmethod
    def correction(self, signals: Signals, values: Values) -> Array:
        """The correction that is added, for every sample by itself (no memory beyond the signals).

        Stage wheel or clock: to the wheel rates, (F, N) rad/s. Steering: to the steering angles, (F, S) rad. Body: to
        the twist of the robot's centre, (F, 3) m/s, m/s, rad/s. World: to the velocity in the reference's frame, (F, 2)
        m/s. Corrections of several effects add up.
        """


class ReferenceEffect(Effect):
    """An effect of stage reference: it changes the poses that the reference reports, not the odometry."""

    stage: ClassVar[Stage] = "reference"

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:  # noqa: ARG002
        """Delays (K,) of position and of heading, s: how much earlier than their stamps (K,) they were measured."""
        return 0 * stamps, 0 * stamps

    def reported(self, poses: Array, start: Array, values: Values) -> Array:  # noqa: ARG002
        """Poses (K, 3) that the reference reports for true poses (K, 3); start (3,): the run's true start pose."""
        return poses

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:  # noqa: ARG002
        """True poses (K, 3) for reported ones: the inverse of ``reported``."""
        return poses


class ActuatorEffect(Effect):
    """An effect of stage actuator: from target to true wheel rates. For simulation; odometry does not need it."""

    stage: ClassVar[Stage] = "actuator"

    @abstractmethod
    def driven(self, durations: Array, targets: Array, values: Values) -> Array:
        """Mean wheel rates (F, N) under targets (F, N), rad/s, from rest; durations (F,): the samples', s."""


effects.contract = Effect


def body_change(signals: Signals, velocity: Array | float = 0.0, turning: Array | float = 0.0) -> Array:
    """A change (F, 3) of the twist of the robot's centre by a velocity (F, 2), m/s, and a rate of turn (F,), rad/s."""
    change = np.zeros(signals.twists.shape)
    change[:, :2] = velocity
    change[:, 2] = turning
    return change


def _total_acceleration(signals: Signals) -> Array:
    forward, left, turn = signals.twists.T
    ahead, aside = signals.accelerations[:, :2].T
    return np.hypot(ahead - turn * left, aside + turn * forward)


# Of each covariate: the end of its range at which it is largest, in words, and its values.
_COVARIATES: dict[str, tuple[str, Callable[[Signals], Array | None]]] = {
    "wheel rate": ("fast wheels", lambda signals: np.abs(signals.rates)),
    "speed": ("fast driving", lambda signals: signals.speed),
    "turning": ("fast turning", lambda signals: np.abs(signals.twists[:, 2])),
    "curvature": (
        "turning on the spot",
        lambda signals: 1 / (1 + signals.speed / np.maximum(np.abs(signals.twists[:, 2]) * signals.robot.reach, 1e-9)),
    ),
    "acceleration": ("large accelerations", _total_acceleration),
    "centripetal acceleration": (
        "large centripetal accelerations",
        lambda signals: np.abs(signals.twists[:, 2]) * signals.speed,
    ),
    "elapsed time": ("the end of a run", lambda signals: signals.elapsed),
    "session time": ("the end of the session", lambda signals: signals.session_time),
    "distance": ("the end of the way", lambda signals: signals.travelled),
    "wheel angle": (
        "wheel angle 0",
        lambda signals: None if signals.wheel_angles is None else np.cos(signals.wheel_angles),
    ),
    "steering angle": (
        "large steering angles",
        lambda signals: None if signals.steering is None else np.abs(signals.steering).mean(axis=1),
    ),
}


def form_covariates(effect: MotionEffect) -> tuple[str, ...]:
    """The covariates with which the size of an effect may vary."""
    if effect.form_covariates is not None:
        return effect.form_covariates
    if effect.shows_in == "command":
        return ("wheel rate",) if effect.stage == "wheel" else ("turning", "speed")
    return _BY_SHOWN.get(effect.shows_in, ())


@dataclass(frozen=True, eq=False)
class Forms:
    """The forms of an effect on some recordings: parameters b_1, b_2, b_w, and the values that scale covariates."""

    parameters: tuple[Parameter, ...]
    scales: Mapping[str, float]


def forms_of(effect: MotionEffect, signals: Signals, corrections: Mapping[str, Array]) -> Forms:
    """The forms that recordings can tell. corrections: the textbook's by 1 of each linear parameter, by its name."""
    linear = [parameter for parameter in _linear(effect, signals.robot) if parameter.name in corrections]
    parameters: list[Parameter] = []
    scales: dict[str, float] = {}
    weight = np.sum([np.square(correction) for correction in corrections.values()], axis=0)
    for covariate in form_covariates(effect):
        values = _covariate(covariate, effect, signals)
        if values is None or np.ptp(values) <= _VARIES * np.abs(values).max():
            continue
        of_samples = weight if values.ndim == 2 else weight.sum(axis=1)
        scale = {"low": float(values.min()), "high": float(np.quantile(values, _TOP))}
        share = _scaled(values, scale["low"], scale["high"])
        total = max(float(of_samples.sum()), 1e-300)
        for power in _POWERS:
            scale[f"mean_{power}"] = float((of_samples * share**power).sum()) / total
        scales |= {f"{covariate}:{key}": value for key, value in scale.items()}
        parameters += [
            _form(parameter, f"{covariate}:{power}", f"over {covariate}, power {power}")
            for parameter in linear
            for power in _POWERS
        ]
    parameters += [
        _form(parameter, f"wheel:{wheel}", f"wheel {wheel} against the mean")
        for parameter in linear
        for wheel in _unequal_wheels(effect, signals.robot)
    ]
    return Forms(tuple(parameters), scales)


def correction_of(effect: MotionEffect, signals: Signals, values: Values) -> Array:
    """The correction by an effect in any of its forms, Eq. (1) and (2). values: its parameters, forms among them."""
    if not any(":" in name for name in values):
        return effect.correction(signals, values)
    textbook = {name: value for name, value in values.items() if ":" not in name}
    correction = effect.correction(signals, textbook)
    # The parameters that are not 0, by what they vary with: speed:1, wheel:a.
    by_form: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        parameter, _, form = name.partition(":")
        if value and form.count(":") == 1:
            by_form.setdefault(form, {})[parameter] = value
    for form, sizes in by_form.items():
        changed = {parameter.name: sizes.get(parameter.name, 0.0) for parameter in _linear(effect, signals.robot)}
        profile = form_profile(form, effect, signals, values)
        correction = correction + effect.correction(signals, textbook | changed) * profile
    return correction


def form_names(effect: MotionEffect, robot: Robot) -> set[str]:
    """Names of the values of all forms of the effect."""
    covariates, linear = form_covariates(effect), [parameter.name for parameter in _linear(effect, robot)]
    forms = [f"{covariate}:{power}" for covariate in covariates for power in _POWERS]
    forms += [f"wheel:{wheel}" for wheel in _unequal_wheels(effect, robot)]
    scales = {f"{covariate}:{key}" for covariate in covariates for key in ("low", "high", "mean_1", "mean_2")}
    return scales | {f"{name}:{form}" for name in linear for form in forms}


def form_in_words(values: Values) -> str:
    """The form of an effect in words: how its size varies, or that it is the textbook's."""
    words = []
    for covariate, (end, _) in _COVARIATES.items():
        varied = {name.partition(":")[0] for name in values if name.endswith((f":{covariate}:1", f":{covariate}:2"))}
        if varied:
            ends = [[_size(values, name, covariate, share) for name in varied] for share in (-1.0, 1.0)]
            least, most = np.linalg.norm(np.array(ends), axis=1).tolist()
            words.append(f"{most / max(least, 1e-300):.2g} times as large at {end} as at the other end")
    if any(":wheel:" in name for name in values):
        words.append("not the same for all wheels")
    return "; ".join(words) or "as in the textbook"


def _size(values: Values, name: str, covariate: str, share: float) -> float:
    """The parameter as it acts at one end of a covariate's range, Eq. (1)."""
    return values[name] + sum(
        values.get(f"{name}:{covariate}:{power}", 0.0) * (share**power - values[f"{covariate}:mean_{power}"])
        for power in _POWERS
    )


def _form(parameter: Parameter, suffix: str, description: str) -> Parameter:
    reach = _LARGEST * parameter.largest
    return Parameter(
        f"{parameter.name}:{suffix}", parameter.unit, -reach, reach, f"change of {parameter.name} {description}"
    )


def _linear(effect: MotionEffect, robot: Robot) -> list[Parameter]:
    return [parameter for parameter in effect.parameters(robot) if not parameter.choices]


def _unequal_wheels(effect: MotionEffect, robot: Robot) -> Sequence[str]:
    """The wheels but the last of an effect that has one parameter for all of them."""
    names = robot.wheel_names
    shared = not any(item.name.endswith(f"_{name}") for item in effect.parameters(robot) for name in names)
    return names[:-1] if effect.stage == "wheel" and shared else ()


def form_profile(key: str, effect: MotionEffect, signals: Signals, values: Values) -> Array:
    """By what a form multiplies the correction, (F, 1) or (F, N): x^n - m_n of Eq. (1), or of Eq. (2)."""
    covariate, _, last = key.partition(":")
    if covariate == "wheel":
        names = signals.robot.wheel_names
        of_wheels = np.array([[1.0 if name == last else 0.0 for name in names]])
        of_wheels[0, -1] = -1.0
        return of_wheels
    share = _scaled(
        needed(_covariate(covariate, effect, signals)), values[f"{covariate}:low"], values[f"{covariate}:high"]
    )
    profile: Array = share ** int(last) - values[f"{covariate}:mean_{last}"]
    return profile if profile.ndim == 2 else profile[:, None]


def _covariate(name: str, effect: MotionEffect, signals: Signals) -> Array | None:
    """A covariate (F,), or of each wheel (F, N) for an effect of the wheels; None if it was not recorded."""
    _, values_of = _COVARIATES[name]
    values = values_of(signals)
    return values.mean(axis=1) if values is not None and values.ndim == 2 and effect.stage != "wheel" else values


def _scaled(values: Array, low: float, high: float) -> Array:
    """A covariate on [-1, 1] from low to high, held outside."""
    return np.clip((2 * values - low - high) / max(high - low, 1e-12), -1.0, 1.0)


def encode_weights(weights: Array) -> str:
    """Weights (n,) as text. DataError: they would be refused by ``decode_weights``."""
    text = base64.b64encode(np.asarray(weights, dtype=_NUMBER).tobytes()).decode("ascii")
    decode_weights(text)
    return text


def decode_weights(text: str, prefix: str = "weights") -> Array:
    """Weights (n,) of a text, as float64.

    DataError, in one line that begins with ``prefix``: the text is no base64, too long, no whole number of float32, or
    holds NaN or infinity.
    """
    try:
        content = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise DataError(f"{prefix} are not base64; copy them whole, or calibrate again") from None
    if len(content) > MOST_BYTES:
        raise DataError(f"{prefix} are longer than {MOST_BYTES // 1024} KiB; train a smaller network")
    if not content or len(content) % _NUMBER.itemsize:
        raise DataError(f"{prefix} are {len(content)} bytes, which is no whole number of float32; copy them whole")
    weights = np.frombuffer(content, dtype=_NUMBER).astype(float)
    if not np.isfinite(weights).all():
        raise DataError(f"{prefix} hold NaN or infinity; calibrate again")
    return weights


@dataclass(frozen=True, eq=False, slots=True)
class Term:
    """An effect with the values of its parameters, each in its unit; weights: as in a calibration file, or None."""

    effect: Effect
    values: Values
    weights: str | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """For other processes: values that cannot be changed cannot be pickled either."""
        return _term_of, (self.effect, dict(self.values), self.weights)

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name


def _term_of(effect: Effect, values: dict[str, float], weights: str | None) -> Term:
    return Term(effect, MappingProxyType(values), weights)


def make_term(
    name: str,
    parameters: Mapping[str, float],
    robot: Robot,
    where: str = "",
    *,
    sessions: tuple[str, ...] = (),
    weights: str | None = None,
) -> Term:
    """The effect called ``name`` with values of its parameters for a robot, in the given order.

    weights: as in a calibration file, for an effect that has some. UnknownNameError: no such effect, or no such
    parameter. DataError: the effect does not apply to the robot, or a parameter is missing, is no finite number, is a
    thousand times larger than plausible, or has ``choices`` and lies outside its range; or the weights are missing, are
    those of another robot, or are none. Messages begin with ``where``.
    """
    effect = effects.create(name, where=where)
    prefix = f"{where}: effect {name!r}" if where else f"effect {name!r}"
    check_applies(effect, robot, prefix)
    listed = {parameter.name: parameter for parameter in effect.parameters(robot, sessions)}
    forms = set[str]()
    if isinstance(effect, MotionEffect) and any(":" in key for key in parameters):
        forms = form_names(effect, robot)
    for key, value in parameters.items():
        if key not in listed and key not in forms and not effect.accepts(key):
            raise UnknownNameError("parameter", key, listed, prefix)
        number: Any = value
        if isinstance(number, bool) or not isinstance(number, Real) or not math.isfinite(number):
            raise DataError(f"{prefix}: parameter {key!r} is {value!r}, not a finite number")
        # Its range, or that of the parameter whose form it is of, or of a covariate's scale; else of an unknown session
        formed = key.partition(":")[0]
        low, high = _SCALES if ":" in key else (-_FAR_OUTSIDE, _FAR_OUTSIDE)
        if (parameter := listed.get(formed)) is not None:
            low, high = parameter.low, parameter.high
            if not parameter.choices:
                low, high = -_FAR_OUTSIDE * parameter.largest, _FAR_OUTSIDE * parameter.largest
        if not low <= value <= high:
            raise DataError(f"{prefix}: parameter {key!r} is {value:g}, not within {low:g} and {high:g}")
    for parameter in listed.values():
        if parameter.name not in parameters:
            raise DataError(
                f"{prefix}: parameter {parameter.name!r} ({parameter.unit}) is missing; {parameter.description}"
            )
    if weights is None and effect.weighted:
        raise DataError(f"{prefix}: weights are missing; take it whole from the file that calibrate wrote")
    if weights is not None:
        if not effect.weighted:
            raise DataError(f"{prefix} has no weights; leave them out")
        effect = effect.with_weights(decode_weights(weights, f"{prefix}: weights"), robot, prefix)
    return Term(effect, MappingProxyType({key: float(value) for key, value in parameters.items()}), weights)


def check_applies(effect: Effect, robot: Robot, prefix: str) -> None:
    """DataError, in one line that begins with ``prefix``: the effect does not apply to the robot."""
    if not effect.applies(robot):
        raise DataError(f"{prefix} is for {effect.only_for}; robot {robot.name} is none, leave the effect out")
