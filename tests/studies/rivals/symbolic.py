"""Symbolic regression: expressions in the covariates for the missing twist, by pyoperon (B. Burlacu et al., 2020).

One expression for the rate of all wheels, of each wheel's own covariates, against one along each axis of the robot;
the one that predicts held-out runs better is used. The expression of a Pareto front is chosen by minimum description
length. Its confidence: the share of further regressions, over other halves of the runs, that end at the same name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyoperon.sklearn import SymbolicRegressor

from omnibench.robot.kinematics import Array

from .problem import COVARIATE_OF, NOTHING, Answer, Problem, Windows

_FINE = 0.25  # s, of the windows in which expressions are evaluated
_SYMBOLS = "add,sub,mul,abs,tanh,constant,variable"


@dataclass(frozen=True, eq=False)
class _Expression:
    """A fitted expression. labels: of the covariates in it. gain: squares of held-out rows that it explains."""

    predict: Callable[[Array], Array]
    labels: frozenset[str]
    gain: float


def answer(
    problem: Problem, rng: np.random.Generator, seconds: float = 1.0, bags: int = 2, population: int = 300
) -> Answer:
    """Search expressions over windows of so many seconds."""
    windows = problem.windows(None, seconds)
    targets = problem.missing_twists(windows)
    found = _search(problem, windows, targets, rng, population)
    if found is None:
        return NOTHING
    twists_of, labels = found
    whole = problem.function_answer(twists_of, _FINE, _covariates(labels), 1.0)
    if not whole.names or not bags:
        return whole
    again = 0
    for _ in range(bags):
        other = _search(problem, windows, targets, rng, population)
        if other is not None:
            names = problem.function_answer(other[0], _FINE, frozenset(), 1.0).names
            again += bool(names) and names[0][0] == whole.names[0][0]
    names = ((whole.names[0][0], again / bags),)
    return Answer(names, whole.unnamed, whole.covariates, whole.values, whole.changes)


def _search(
    problem: Problem, windows: Windows, targets: Array, rng: np.random.Generator, population: int
) -> tuple[Callable[[Windows], Array], frozenset[str]] | None:
    """Twists by the better of both kinds of expressions, and their labels; None if held-out runs gain nothing."""
    held_out = rng.random(int(windows.run.max()) + 1)[windows.run] < 1 / 3
    scale = targets.std(axis=0)
    of_body = [
        _regressed(windows.covariates, targets[:, axis] / scale[axis], windows.labels, held_out, rng, population)
        for axis in range(3)
    ]
    matrix = problem.plain.model.matrix
    back = np.linalg.pinv(matrix)
    wheels = range(matrix.shape[1])
    own = [_own(windows, wheel) for wheel in wheels]
    rates = targets @ back.T
    size = float(rates.std())
    labels = own[0][1]
    of_wheels = _regressed(
        np.concatenate([values for values, _ in own]),
        np.concatenate([rates[:, wheel] / size for wheel in wheels]),
        labels,
        np.tile(held_out, len(own)),
        rng,
        population,
    )
    gain_of_body = sum(max(expression.gain, 0.0) for expression in of_body)
    # Squares of wheel rates in units of their own scatter, against those of the twist in units of its own
    predicted = np.column_stack([of_wheels.predict(values) for values, _ in own]) * size @ matrix.T
    left = (targets - predicted)[held_out] / scale
    gain_of_wheels = float(np.square(targets[held_out] / scale).sum() - np.square(left).sum())
    if max(gain_of_body, gain_of_wheels) <= 3.0:
        return None
    if gain_of_wheels > gain_of_body:

        def by_wheels(at: Windows) -> Array:
            values = [of_wheels.predict(_own(at, wheel)[0]) for wheel in wheels]
            return size * np.column_stack(values) @ matrix.T

        return by_wheels, of_wheels.labels
    used = [(axis, each) for axis, each in enumerate(of_body) if each.gain > 0]

    def by_axes(at: Windows) -> Array:
        twists = np.zeros((len(at.run), 3))
        for axis, expression in used:
            twists[:, axis] = scale[axis] * expression.predict(at.covariates)
        return twists

    return by_axes, frozenset().union(*(each.labels for _, each in used))


def _regressed(
    inputs: Array,
    target: Array,
    labels: Sequence[str],
    held_out: NDArray[np.bool_],
    rng: np.random.Generator,
    population: int,
) -> _Expression:
    """The expression of minimum description length for a target (n,) of unit scatter."""
    spread = np.maximum(np.abs(inputs).max(axis=0), 1e-9)
    regressor = SymbolicRegressor(
        allowed_symbols=_SYMBOLS,
        max_length=15,
        max_depth=6,
        population_size=population,
        generations=60,
        max_evaluations=25_000,
        optimizer_iterations=3,
        objectives=["r2", "length"],
        uncertainty=[1.0],
        n_threads=1,
        random_state=int(rng.integers(2**31)),
    )
    regressor.fit(inputs[~held_out] / spread, target[~held_out])
    chosen = min(regressor.pareto_front_, key=lambda each: each["minimum_description_length"])

    def predict(values: Array) -> Array:
        return np.asarray(regressor.evaluate_model(chosen["tree"], values / spread), dtype=float).ravel()

    explained = np.square(target[held_out]).sum() - np.square(target[held_out] - predict(inputs[held_out])).sum()
    variables = frozenset(labels[int(name[1:]) - 1] for name in chosen["variables"])
    return _Expression(predict, variables, float(explained))


def _own(windows: Windows, wheel: int) -> tuple[Array, tuple[str, ...]]:
    """A wheel's own covariates (n, c): its rate and angle, and those that all wheels share."""
    names = windows.paths.robot.wheel_names
    columns = dict(zip(windows.labels, windows.covariates.T, strict=True))
    shared = ("elapsed", "travelled", "session")
    chosen = {name: columns[name] for name in shared if name in columns}
    chosen |= {
        part: columns[f"{part}_{names[wheel]}"]
        for part in ("rate", "cos", "sin")
        if f"{part}_{names[wheel]}" in columns
    }
    speed = np.hypot(columns["vx"], columns["vy"])
    outward = windows.paths.robot.measured[wheel].outward
    centripetal = columns["w"] * np.column_stack([-columns["vy"], columns["vx"]]).T
    load = (columns["ax"] + centripetal[0]) * np.cos(outward) + (columns["ay"] + centripetal[1]) * np.sin(outward)
    chosen |= {"speed": speed, "load": load}
    return np.column_stack(list(chosen.values())), tuple(chosen)


def _covariates(labels: frozenset[str]) -> frozenset[str]:
    known = COVARIATE_OF | {"speed": "command", "load": "acceleration"}
    return frozenset(known.get(label, known.get(label.rpartition("_")[0], "")) for label in labels)
