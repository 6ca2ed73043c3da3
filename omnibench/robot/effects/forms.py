"""Forms of an effect: its size varies with a covariate, or from wheel to wheel, where the textbook has it constant.

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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

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


def _speed(signals: Signals) -> Array:
    return np.hypot(signals.twists[:, 0], signals.twists[:, 1])


def _total_acceleration(signals: Signals) -> Array:
    forward, left, turn = signals.twists.T
    ahead, aside = signals.accelerations[:, :2].T
    return np.hypot(ahead - turn * left, aside + turn * forward)


_COVARIATES: dict[str, Callable[[Signals], Array | None]] = {
    "wheel rate": lambda signals: np.abs(signals.rates),
    "speed": _speed,
    "turning": lambda signals: np.abs(signals.twists[:, 2]),
    "acceleration": _total_acceleration,
    "centripetal acceleration": lambda signals: np.abs(signals.twists[:, 2]) * _speed(signals),
    "elapsed time": lambda signals: signals.elapsed,
    "session time": lambda signals: signals.session_time,
    "distance": lambda signals: signals.travelled,
    "wheel angle": lambda signals: None if signals.wheel_angles is None else np.cos(signals.wheel_angles),
    "steering angle": lambda signals: None if signals.steering is None else np.abs(signals.steering).mean(axis=1),
}
_IN_WORDS = {
    "wheel rate": "fast wheels",
    "speed": "fast driving",
    "turning": "fast turning",
    "acceleration": "large accelerations",
    "centripetal acceleration": "large centripetal accelerations",
    "elapsed time": "the end of a run",
    "session time": "the end of the session",
    "distance": "the end of the way",
    "wheel angle": "wheel angle 0",
    "steering angle": "large steering angles",
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
    robot, linear = (
        signals.robot,
        {each.name: each for each in _linear(effect, signals.robot) if each.name in corrections},
    )
    parameters: list[Parameter] = []
    scales: dict[str, float] = {}
    weight = np.sum([np.square(each) for each in corrections.values()], axis=0)
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
            _form(each, f"{covariate}:{power}", f"over {covariate}, power {power}")
            for each in linear.values()
            for power in _POWERS
        ]
    parameters += [
        _form(each, f"wheel:{wheel}", f"wheel {wheel} against the mean")
        for each in linear.values()
        for wheel in _unequal_wheels(effect, robot)
    ]
    return Forms(tuple(parameters), scales)


def correction_of(effect: MotionEffect, signals: Signals, values: Values) -> Array:
    """The correction by an effect in any of its forms, Eq. (1) and (2). values: its parameters, forms among them."""
    if not any(":" in name for name in values):
        return effect.correction(signals, values)
    textbook = {name: value for name, value in values.items() if ":" not in name}
    correction = effect.correction(signals, textbook)
    for key, weights in _forms_given(values).items():
        changed = {each.name: weights.get(each.name, 0.0) for each in _linear(effect, signals.robot)}
        correction = correction + effect.correction(signals, textbook | changed) * form_profile(
            key, effect, signals, values
        )
    return correction


def accepts_form(effect: MotionEffect, robot: Robot, name: str) -> bool:
    """True for the name of a value of one of the effect's forms."""
    first, _, rest = name.partition(":")
    if first in form_covariates(effect):
        return rest in ("low", "high", *(f"mean_{power}" for power in _POWERS))
    if first not in {each.name for each in _linear(effect, robot)}:
        return False
    covariate, _, last = rest.rpartition(":")
    if covariate == "wheel":
        return last in _unequal_wheels(effect, robot)
    return covariate in form_covariates(effect) and last in map(str, _POWERS)


def form_in_words(values: Values) -> str:
    """The form of an effect in words: how its size varies, or that it is the textbook's."""
    words = []
    for covariate, end in _IN_WORDS.items():
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


def _linear(effect: MotionEffect, robot: Robot) -> Iterator[Parameter]:
    return (each for each in effect.parameters(robot) if not each.choices)


def _unequal_wheels(effect: MotionEffect, robot: Robot) -> Sequence[str]:
    """The wheels but the last of an effect that has one parameter for all of them."""
    names = robot.wheel_names
    shared = not any(each.name.endswith(f"_{name}") for each in effect.parameters(robot) for name in names)
    return names[:-1] if effect.stage == "wheel" and shared else ()


def _forms_given(values: Values) -> dict[str, dict[str, float]]:
    """The parameters that are not 0, by what they vary with: ``speed:1``, ``wheel:a``."""
    given: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        first, _, rest = name.partition(":")
        if value and rest.count(":") == 1:
            given.setdefault(rest, {})[first] = value
    return given


def form_profile(key: str, effect: MotionEffect, signals: Signals, values: Values) -> Array:
    """By what a form multiplies the correction, (F, 1) or (F, N): x^n - m_n of Eq. (1), or of Eq. (2)."""
    covariate, _, last = key.partition(":")
    if covariate == "wheel":
        names = signals.robot.wheel_names
        of_wheels = np.array([[1.0 if name == last else 0.0 for name in names]])
        of_wheels[0, -1] = -1.0
        return of_wheels
    shown = _covariate(covariate, effect, signals)
    assert shown is not None  # it was recorded
    share = _scaled(shown, values[f"{covariate}:low"], values[f"{covariate}:high"])
    profile: Array = share ** int(last) - values[f"{covariate}:mean_{last}"]
    return profile if profile.ndim == 2 else profile[:, None]


def _covariate(name: str, effect: MotionEffect, signals: Signals) -> Array | None:
    """A covariate (F,), or of each wheel (F, N) for an effect of the wheels; None if it was not recorded."""
    values = _COVARIATES[name](signals)
    return values.mean(axis=1) if values is not None and values.ndim == 2 and effect.stage != "wheel" else values


def _scaled(values: Array, low: float, high: float) -> Array:
    """A covariate on [-1, 1] from low to high, held outside."""
    return np.clip((2 * values - low - high) / max(high - low, 1e-12), -1.0, 1.0)
