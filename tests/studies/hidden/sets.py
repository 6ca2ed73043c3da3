"""Data sets with something hidden in them, and apart from them the truth."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.robot.kinematics import Array

from .absorbed import ABSORBED, ACTUATORS, NUISANCES
from .distorted import distorted
from .disturbances import DISTURBANCES, VALIDATION, Disturbance, scaled
from .experiment import DESIGNS, RAMP, ROBOT, SAMPLE, Run, plan, true_matrix
from .fine_structure import FINE
from .form import Form, Make, Values
from .forms import FORMS
from .motion import Correction, Grid
from .outside import OUTSIDE, Unheard
from .signature import Sight

Kind = Literal["single", "pair", "outside", "null", "absorbed", "nuisance", "actuator"]
FormName = Literal["matched", "blind", "third", "distorted"]
LEVELS = {"strong": 1000.0, "medium": 300.0, "weak": 100.0}
UNHEARD = {**OUTSIDE, **FINE}
LARGEST = 3.0  # times the plausible range; what needs more is not reachable


@dataclass(frozen=True)
class Hidden:
    """One effect as it was put in. values: of its parameters. size: in plausible ranges. level: what it came to."""

    name: str
    values: dict[str, float]
    size: float
    level: float

    @property
    def reachable(self) -> bool:
        return self.size <= LARGEST


@dataclass(frozen=True, eq=False)
class Truth:
    """Truth of a data set. clean: its runs without noise.

    covariates, called: of effects outside the catalogue only; called: names that it has for them after all.
    """

    kind: Kind
    hidden: tuple[Hidden, ...]
    form: FormName
    design: str
    noise: str
    matrix: Array
    disturbance: Disturbance
    runs: tuple[Run, ...]
    clean: tuple[Trajectory, ...]
    seeds: tuple[tuple[int, ...], ...]
    covariates: tuple[str, ...] = ()
    called: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return (*(each.name for each in self.hidden), *self.called)

    @property
    def reachable(self) -> bool:
        return self.kind == "outside" or all(each.reachable for each in self.hidden)

    def sight(self) -> Sight:
        """How effects are seen in the training runs, under the true noise."""
        training = [run for run in self.runs if run.split == "train"]
        return Sight(training, self.matrix, self.disturbance.known(self.matrix))

    def signature(self, sight: Sight) -> Array:
        """The whitened signature of all that is hidden, beyond the matrix."""
        parts = [
            make_of(self.kind, each.name, self.form)(sight.grid, each.values, np.random.default_rng(seed))
            for each, seed in zip(self.hidden, self.seeds, strict=True)
        ]
        return sight.of(sum(parts[1:], parts[0]))


def make_set(
    kind: Kind,
    effect: str | Sequence[str],
    level: str | float,
    seed: int,
    *,
    form: FormName = "blind",
    design: str | None = None,
    noise: str = "plain",
) -> tuple[Dataset, Truth]:
    """A data set of 180 + 180 runs and its truth.

    effect: one name, two for a pair, "" for "null". level: "strong", "medium", "weak" or a non-centrality; absorbed
    effects have their largest plausible size instead. noise: one of DISTURBANCES. design: one of DESIGNS.
    """
    names: tuple[str, ...] = () if kind == "null" else (effect,) if isinstance(effect, str) else tuple(effect)
    key = [zlib.crc32(" ".join([kind, form, *names]).encode()), seed]
    rng = np.random.default_rng(key)
    design = design or _design_of(kind, names, seed)
    runs, matrix = plan(DESIGNS[design], rng), true_matrix(rng)
    disturbance = scaled(DISTURBANCES[noise], DESIGNS[design].noise)
    seeds = tuple((*key, number) for number in range(len(names)))
    training = [run for run in runs if run.split == "train"]
    sight = Sight(training, matrix, disturbance.known(matrix)) if names else None
    hidden = tuple(
        _hide(sight, kind, name, level, form, seeds[number], rng, disturbance)
        for number, name in enumerate(names)
        if sight is not None
    )
    grid, correction = Grid(runs, matrix), Correction()
    for each, each_seed in zip(hidden, seeds, strict=True):
        correction += make_of(kind, each.name, form)(grid, each.values, np.random.default_rng(each_seed))
    clean = _trajectories(grid, grid.poses(correction), _Wheels.of(grid, correction))
    dataset = make_dataset("recording", ROBOT, SAMPLE, recorded(grid, correction, disturbance, rng), simulated=True)
    covariates, called = (), ()
    if kind == "outside":
        unheard = UNHEARD[names[0]]
        covariates, called = unheard.covariates, unheard.called(np.random.default_rng(seeds[0]))
    return dataset, Truth(
        kind, hidden, form, design, noise, matrix, disturbance, runs, clean, seeds, covariates, called
    )


def form_of(kind: Kind, name: str) -> Form:
    """The form of an effect that the catalogue has."""
    return {"absorbed": ABSORBED, "nuisance": NUISANCES, "actuator": ACTUATORS}.get(kind, FORMS)[name]


def make_of(kind: Kind, name: str, form: FormName) -> Make:
    """The function that turns values into a correction."""
    if kind == "outside":
        return UNHEARD[name].make
    found = form_of(kind, name)
    forms = {"matched": found.matched, "blind": found.blind, "third": found.third, "distorted": distorted(found.blind)}
    return forms[form]


def _design_of(kind: Kind, names: Sequence[str], seed: int) -> str:
    """By turns one of those in which the effect can be told from all others."""
    if kind == "null":
        return ("rich", "flower")[seed % 2]
    if kind == "single":
        designs = FORMS[names[0]].designs
        return designs[seed % len(designs)]
    if kind == "outside":
        return UNHEARD[names[0]].design
    return "sessions" if kind == "pair" and "tyre_wear" in names else "rich"


def _hide(
    sight: Sight,
    kind: Kind,
    name: str,
    level: str | float,
    form: FormName,
    seed: Sequence[int],
    rng: np.random.Generator,
    disturbance: Disturbance,
) -> Hidden:
    make, wanted = make_of(kind, name, form), LEVELS[level] if isinstance(level, str) else level
    known = UNHEARD[name] if kind == "outside" else form_of(kind, name)
    direction = {"size": float(rng.choice([-1.0, 1.0])) * known.plausible} if isinstance(known, Unheard) else None
    values: Values = direction or form_of(kind, name).direction(rng)

    def at(size: float) -> dict[str, float]:
        if isinstance(known, Unheard):
            return {"size": values["size"] * size}
        return known.scaled(values, size)

    def correction(size: float) -> Correction:
        return make(sight.grid, at(size), np.random.default_rng(seed))

    if kind == "actuator":
        asked = correction(1.0).asked
        assert asked is not None
        return Hidden(name, at(1.0), 1.0, float((sight.grid.sample_means(asked) ** 2).sum() / disturbance.encoder**2))
    if kind in ("absorbed", "nuisance"):
        return Hidden(name, at(1.0), 1.0, _square(sight.of(correction(1.0))))
    size, reached = 0.1, _square(sight.of(correction(0.1)))
    for _ in range(6):  # most effects act linearly: then the first step is enough
        if abs(reached / wanted - 1) < 0.01:
            break
        size *= math.sqrt(wanted / reached)
        reached = _square(sight.of(correction(size)))
    return Hidden(name, at(size), size, reached)


def _square(values: Array) -> float:
    return float(values @ values)


@dataclass(frozen=True, eq=False)
class _Wheels:
    """Mean and target rates, rad/s, and wheel angles, rad, of all samples of all runs (F, N)."""

    rates: Array
    asked: Array
    turned: Array

    @staticmethod
    def of(grid: Grid, correction: Correction) -> _Wheels:
        rates = grid.sample_means(grid.rates)
        asked = rates if correction.asked is None else rates + grid.sample_means(correction.asked)
        return _Wheels(rates, asked, np.cumsum(rates * SAMPLE, axis=0))


def recorded(
    grid: Grid, correction: Correction, disturbance: Disturbance, rng: np.random.Generator
) -> tuple[Trajectory, ...]:
    """The recordings of wheels and reference."""
    if correction.chance is not None:
        correction += correction.chance
    if disturbance.slip:
        spread = disturbance.slip / math.sqrt(grid.step)
        correction += Correction(body=spread * rng.standard_normal((len(grid.run), 3)))
    training = np.array([run.split == "train" for run in grid.runs])[grid.stamp_run]
    quiet, loud = disturbance.of_poses(grid, rng), scaled(disturbance, VALIDATION).of_poses(grid, rng)
    wheels = _Wheels.of(grid, correction)
    noisy = replace(
        wheels,
        rates=wheels.rates + disturbance.of_rates(wheels.rates.shape, rng),
        turned=wheels.turned + 1e-3 * rng.standard_normal(wheels.turned.shape),
    )
    return _trajectories(grid, grid.poses(correction) + np.where(training[:, None], quiet, loud), noisy)


def _trajectories(grid: Grid, poses: Array, wheels: _Wheels) -> tuple[Trajectory, ...]:
    """The runs with these poses (s, 3). Their names say nothing of what is hidden."""
    first = np.concatenate([[0], np.cumsum([run.command.samples for run in grid.runs])])
    still = np.vstack([np.zeros(wheels.rates.shape[1]), np.cumsum(grid.sample_means(grid.rates) * SAMPLE, axis=0)])
    found = []
    for index, run in enumerate(grid.runs):
        samples = slice(first[index], first[index + 1])
        duration = run.command.samples * SAMPLE
        found.append(
            Trajectory(
                id=f"{run.split}-{index:03d}",
                split=run.split,
                times=SAMPLE * np.arange(1, run.command.samples + 1),
                rates=wheels.rates[samples],
                pose_times=run.stamps,
                poses=poses[grid.stamp_first[index] : grid.stamp_first[index + 1]],
                command=run.command.name,
                repetition=run.repetition,
                session=run.session,
                started_at=run.started_at,
                v=run.command.speed,
                alpha=run.command.direction,
                omega=run.command.turn,
                duration=duration,
                distance=run.command.speed * (duration - RAMP),
                angles=run.angles + wheels.turned[samples] - still[first[index]],
                targets=wheels.asked[samples],
            )
        )
    return tuple(found)
