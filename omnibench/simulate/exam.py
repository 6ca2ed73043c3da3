"""An exam for whatever finds effects in recordings: simulated data sets, and a key that is sealed until it is graded.

From a seed follow, for every data set, a robot whose wheels are a little off their design, its motion commands, noise,
and none, one or two hidden effects. The seed stays with whoever sets the exam; the folder holds a hash of seed and key,
so that neither can be changed later, nor be guessed by trying all effects.

The size of an effect is its non-centrality: with s the change of all training poses by the effect, J their derivatives
by the matrix's elements (and by what else is hidden), and L L^T the covariance of the noise, it is

    lambda = min over a of |L^-1 (s - J a)|^2,                                                              (1)

that is the expected chi-square difference, less the parameters' number, between models with and without it. An effect
that the matrix absorbs has lambda = 0 at every size, and is not hidden.
"""

from __future__ import annotations

import hashlib
import json
import math
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from omnibench.config import Model, read_yaml, to_json, validate
from omnibench.data.storage import save_dataset
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, DataError, Interrupted, require_choice
from omnibench.files import check_place, read_text, results_locked, write_text
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import effects
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.effects.effect import Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.simulate import commands as motion
from omnibench.simulate.config import EncoderNoise, FlowerConfig, Session, Tolerances, Truth
from omnibench.simulate.robot_simulator import flower_session, simulate_flower
from omnibench.simulate.truth import true_record
from omnibench.words import plural

SEALED = "sealed.json"
ROBOTS = ("omni", "mecanum", "differential", "skid", "tricycle", "car", "swerve")  # as in exam_robots.yaml
LEVELS = {"strong": 1000.0, "medium": 300.0, "weak": 100.0}  # non-centralities, as in tests/studies/hidden

_COUNTS = (1 / 6, 1 / 2, 1 / 3)  # shares of sets with none, one and two hidden effects; chosen
_LARGEST = 2.0  # times its plausible size: an effect that shows only beyond it is not hidden; chosen
_SEPARATE = 0.5  # share of lambda that the other hidden effect must leave; chosen
_ATTEMPTS = 20  # drawn sets in which none of the effects shows before an exam is refused; chosen
_PROBE = 1e-3  # times its plausible size: an effect that is so small acts linearly on the poses
_STEP = 1e-6  # m or rad per rad, of an element of the matrix, by which the poses are differentiated
_REPETITIONS = 3  # of each command, from which the noise is known; chosen
_SPINS, _CURVES = 0.2, 0.7  # shares: of turns on the spot among commands, of curves among the others; chosen
_SPEEDS = (0.12, 0.45)  # m/s; chosen
_FASTEST_TURN = 0.5  # rad/s while driving, twice as fast on the spot; chosen
# Ranges of the noise, from motion capture to SLAM: rad/s, m and rad, the walks per sqrt s; chosen.
_NOISE = {
    "encoder": (0.005, 0.02), "pose_position": (0.001, 0.005), "pose_heading": (0.001, 0.005),
    "walk_position": (0.0005, 0.003), "walk_heading": (0.0005, 0.003), "bias_position": (0.001, 0.006),
    "bias_heading": (0.001, 0.006),
}  # fmt: skip
_HOW_TO_ANSWER = (
    "Each set is a data set of one robot, with none, one or two hidden effects. Answer with one JSON document by "
    "answer_schema, or with a folder that holds SET/discovery.json (omnibench discover DIR/SET -o ANSWERS/SET). A set "
    "without an answer counts as unknown. Whoever set the exam grades it with its seed (omnibench exam grade)."
)


class ExamOptions(Model):
    """Options of an exam: its sets and what may be hidden in them."""

    sets: int = Field(12, gt=0, le=999, description="Number of data sets.")
    robots: tuple[str, ...] = Field(
        (), validate_default=True, description=f"Classes of robots, with commas between. Default: {', '.join(ROBOTS)}."
    )
    effects: tuple[str, ...] = Field(
        (), validate_default=True, description="Effects that may be hidden, with commas between. Default: all."
    )
    size: Literal["strong", "medium", "weak"] = Field(
        "medium", description="Chi-square of each effect: strong 1000, medium 300, weak 100."
    )
    runs: int = Field(90, ge=12, le=2000, description="Training runs of each set; as many validate.")

    @field_validator("robots", "effects", mode="before")
    @classmethod
    def _known_names(cls, given: Any, info: ValidationInfo) -> tuple[str, ...]:
        """Names from a list whose entries may hold several, with commas between; all that there are from an empty one.

        Effects: those built in that can be an answer.
        """
        known: tuple[str, ...] = ROBOTS
        if info.field_name == "effects":
            built_in = [entry.cls for entry in effects.entries() if entry.origin == "built in"]
            known = tuple(effect.name for effect in built_in if effect.in_catalogue and not effect.run_nuisance)
        listed = [given] if isinstance(given, str) else given
        names = tuple(name.strip() for each in listed for name in str(each).split(",") if name.strip())
        for name in names:
            require_choice(str(info.field_name)[:-1], name, known, f"--{info.field_name}")
        return names or known


class SealedExam(Model):
    """The file sealed.json. key_sha256: of seed and key. answer_schema: JSON schema of ANSWERS.json."""

    format: Literal["omnibench-exam/1"] = "omnibench-exam/1"
    omnibench: str = Field(description="version that made the sets")
    options: ExamOptions
    sets: tuple[str, ...]
    key_sha256: str
    how_to_answer: str = _HOW_TO_ANSWER
    answer_schema: dict[str, Any]


def make_exam(
    folder: Path,
    options: ExamOptions,
    answer_schema: Mapping[str, Any],
    seed: int | None = None,
    watch: Reporter = no_progress,
) -> int:
    """Write the sets of an exam and sealed.json to a folder; returns the seed, which opens it.

    seed: default: drawn from the system's entropy. Sets that an interrupted call with the same seed and options has
    written are kept. ConfigError in one line: the folder holds something else, or no set shows any of the effects.
    """
    if folder.exists() and not (folder / SEALED).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder}: holds other files; name a new folder")
    earlier = read_sealed(folder) if (folder / SEALED).is_file() else None
    if earlier is not None and (seed is None or earlier.options != options):
        raise ConfigError(f"{folder}: holds an exam; name a new folder, or go on with its options and its --seed")
    check_place(folder)
    seed, written = secrets.randbits(63) if seed is None else seed, 0
    try:
        configs = draw_sets(options, seed, watch)
        sealed = SealedExam(
            omnibench=package_versions().get("omnibench", "unknown"),
            options=options,
            sets=tuple(configs),
            key_sha256=key_hash(configs, seed),
            answer_schema=dict(answer_schema),
        )
        if earlier is not None and earlier.key_sha256 != sealed.key_sha256:
            raise ConfigError(f"{folder}: holds an exam of another seed; name a new folder, or give that seed")
        with results_locked(folder):
            write_text(folder / SEALED, to_json(sealed) + "\n")
        for written, (name, config) in enumerate(configs.items()):
            watch(Progress("driving the sets", written, len(configs), "set"))
            if not (folder / name / "dataset.yaml").is_file():
                save_dataset(simulate_flower(config, name).dataset, folder / name)
        watch(Progress("driving the sets", len(configs), len(configs), "set"))
    except KeyboardInterrupt:
        of_all = f"{written} of {plural(options.sets, 'set')} are written"
        raise Interrupted(f"interrupted; {of_all}, and the same command with --seed {seed} goes on") from None
    return seed


def read_sealed(folder: Path) -> SealedExam:
    """The file sealed.json of an exam's folder. OmnibenchError in one line: it is none."""
    return validate(SealedExam, read_json(folder / SEALED), str(folder / SEALED))


def read_json(file: Path) -> Any:
    """The content of a JSON file. DataError in one line: it cannot be read, or is none."""
    try:
        return json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file}: not valid JSON: {error}") from None


def open_exam(folder: Path, seed: int, watch: Reporter = no_progress) -> dict[str, FlowerConfig]:
    """The configs of an exam's sets, with their truths, by name. ConfigError: the seed is not the exam's."""
    sealed = read_sealed(folder)
    configs = draw_sets(sealed.options, seed, watch)
    if key_hash(configs, seed) != sealed.key_sha256:
        here = package_versions().get("omnibench", "unknown")
        other = "" if here == sealed.omnibench else f" (made by omnibench {sealed.omnibench}; this is {here})"
        raise ConfigError(f"--seed {seed} does not open {folder / SEALED}; give the one that exam make printed{other}")
    return configs


def key_hash(configs: Mapping[str, FlowerConfig], seed: int) -> str:
    """SHA-256 of the seed and the canonical JSON of all truths: true robots and hidden effects."""
    truths = {name: config.truth.model_dump(mode="json", exclude_defaults=True) for name, config in configs.items()}
    robots = {name: config.robot.model_dump(mode="json") for name, config in configs.items()}
    key = json.dumps([str(seed), truths, robots], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(key.encode()).hexdigest()


def draw_sets(options: ExamOptions, seed: int, watch: Reporter = no_progress) -> dict[str, FlowerConfig]:
    """The configs of all sets by name, of which the seed decides every number.

    ConfigError: none of the effects shows in any recording that was drawn.
    """
    configs = {}
    for number in range(1, options.sets + 1):
        configs[f"set-{number:03d}"] = _draw_set(options, np.random.default_rng([seed, number]))
        watch(Progress("drawing the sets", number, options.sets, "set"))
    return configs


def _draw_set(options: ExamOptions, rng: np.random.Generator) -> FlowerConfig:
    """Recordings with as many hidden effects as show in them, up to a number that is drawn."""
    count = int(rng.choice(len(_COUNTS), p=_COUNTS))
    for _ in range(_ATTEMPTS):
        config = _recordings(options, str(rng.choice(options.robots)), rng)
        if count == 0:
            return config
        view, hidden, signatures = EffectView(config), list[EffectTerm](), list[Array]()
        for name in rng.permutation(options.effects).tolist():
            term = _sized(view, name, LEVELS[options.size], signatures, rng)
            if term is not None:
                hidden.append(term)
                signatures.append(view.signature(term))
            if len(hidden) == count:
                break
        if hidden:
            return config.model_copy(update={"truth": config.truth.model_copy(update={"effects": tuple(hidden)})})
    raise ConfigError(
        f"no effect that is allowed shows as {options.size} in {plural(options.runs, 'run')} of a robot of class "
        f"{' or '.join(options.robots)}; allow others (--effects, --robots), more --runs, or a smaller --size"
    )


class EffectView:
    """The training runs of a config, in which effects show beyond what the matrix can absorb, Eq. (1).

    Effects act as in the catalogue, to first order; the sets themselves are driven by mechanics of their own.
    """

    def __init__(self, config: FlowerConfig) -> None:
        self.config, self.robot = config, config.robot
        plain = true_record(config, "exam").true_robot()
        self.matrix = plain.model.matrix
        drive = None if self.robot.drive.direct else self.robot.drive
        quiet = config.model_copy(update={"noise": EncoderNoise()})
        runs = [replace(run, drive=drive) for run in flower_session(quiet, plain, "train", config.train)]
        self._logs = [run.reference_log for run in runs]
        self._before = self._reported(self.matrix)

    def signature(self, term: EffectTerm) -> Array:
        """Whitened change (n,) of the training poses by an effect."""
        return self._whitened(self._reported(self.matrix, (term.term(self.robot),)))

    def noncentrality(self, signature: Array, others: Sequence[Array] = ()) -> float:
        """Eq. (1), with signatures (n,) of other effects among the columns that can absorb it."""
        left = np.column_stack([*others, signature])
        left = left - self._absorbing @ (self._absorbing.T @ left)
        return float(np.linalg.qr(left)[1][-1, -1] ** 2)

    @cached_property
    def _absorbing(self) -> Array:
        """Orthonormal columns (n, 3 M or less) of the whitened derivatives by the matrix's elements."""
        columns = []
        for element in np.ndindex(*self.matrix.shape):
            changed = self.matrix.copy()
            changed[element] += _STEP
            columns.append(self._whitened(self._reported(changed)) / _STEP)
        left, sizes, _ = np.linalg.svd(np.column_stack(columns), full_matrices=False)
        absorbing: Array = left[:, sizes > _STEP * sizes[0]]
        return absorbing

    def _reported(self, matrix: Array, terms: tuple[Term, ...] = ()) -> list[Array]:
        return OdometryModel(self.robot, matrix, "arc", terms, self.config.sample_period).reported(self._logs)

    @cached_property
    def _inverse_factors(self) -> list[Array]:
        """L^-1 (3, K, K) of each run, for x, y and heading; white noise of the wheel rates adds to the random walk."""
        noise, matrix = self.config.noise, self.matrix
        rates = noise.encoder * math.sqrt(self.config.sample_period)  # rad per sqrt s
        by_rates = rates * np.array([np.linalg.norm(matrix[:2]) / math.sqrt(2), np.linalg.norm(matrix[2])])
        white = np.square([noise.pose_position, noise.pose_heading])
        walk = np.square([noise.walk_position, noise.walk_heading]) + by_rates**2
        bias = np.square([noise.bias_position, noise.bias_heading])
        white, walk, bias = (variances[[0, 0, 1], None, None] for variances in (white, walk, bias))
        return [
            np.linalg.inv(np.linalg.cholesky(white * np.eye(len(t)) + walk * np.minimum(t[:, None], t) + bias))
            for t in (log.stamps for log in self._logs)
        ]

    def _whitened(self, poses: Sequence[Array]) -> Array:
        """Change (n,) of all poses, each run's (K, 3), from those before, of unit variance."""
        changed = zip(self._inverse_factors, poses, self._before, strict=True)
        return np.concatenate([(factor @ (after - before).T[:, :, None]).ravel() for factor, after, before in changed])


def _sized(
    view: EffectView, name: str, level: float, others: Sequence[Array], rng: np.random.Generator
) -> EffectTerm | None:
    """An effect of a non-centrality; None if it does not apply, or does not show at a plausible size.

    others: signatures (n,) of what is hidden already.
    """
    effect = effects.create(name)
    if not effect.applies(view.robot):
        return None
    parameters = effect.parameters(view.robot, ("train", "validation"))
    draws = rng.standard_normal(len(parameters))
    draws /= max(abs(draw) for draw, each in zip(draws, parameters, strict=True) if not each.choices)

    def at(size: float) -> EffectTerm:
        values = {}
        for each, draw, choice in zip(parameters, draws.tolist(), choices, strict=True):
            signed = abs(draw) if each.low >= 0 else draw
            values[each.name] = each.choices[choice] if each.choices else _rounded(size * signed * each.largest)
        return EffectTerm(name=name, parameters=values)

    choices = [int(rng.integers(max(len(each.choices), 1))) for each in parameters]
    signature = view.signature(at(_PROBE)) / _PROBE
    alone, beyond = view.noncentrality(signature), view.noncentrality(signature, others)
    if beyond < _SEPARATE * alone or level > _LARGEST**2 * beyond:
        return None
    return at(math.sqrt(level / beyond))


def _rounded(value: float) -> float:
    """A value of three digits, which machines that round differently in the last bit agree on, and on its hash."""
    return float(f"{value:.3g}")


def _recordings(options: ExamOptions, kind: str, rng: np.random.Generator) -> FlowerConfig:
    """A robot of a class, drawn about its design, with its commands and noise, and nothing hidden."""
    factors = dict(zip(("radius", "length"), rng.uniform(0.7, 1.4, 2).tolist(), strict=True))
    scaled = {"radius": factors["radius"]} | dict.fromkeys(("x", "y", "distance"), factors["length"])
    design = read_yaml(Path(__file__).with_name("exam_robots.yaml"))[kind]
    wheels = [
        wheel | {key: _rounded(factor * wheel[key]) for key, factor in scaled.items() if key in wheel}
        for wheel in design["wheels"]
    ]
    robot = Robot(**design | {"name": "robot", "wheels": wheels})
    by_distance, is_car = "distance" in wheels[0], kind == "car"
    askew = 0.1 if is_car else 1.0  # a car with crooked axles looks as if its steering had an offset
    tolerances = Tolerances(
        seed=int(rng.integers(2**62)),
        radius=0.01,
        distance=0.01 if by_distance else 0.0,
        position=0.0 if by_distance else askew * 0.003,
        angle_deg=askew * 0.3,
        steering_deg=0.5 if robot.drive.steered and not is_car else 0.0,
        mount=0.005,
    )
    noise = {name: _rounded(rng.uniform(*between)) for name, between in _NOISE.items()}
    train, validation = (Session(seed=int(seed), distance=1.0) for seed in rng.integers(2**62, size=2))
    return FlowerConfig(
        robot=robot,
        sample_period=0.02,
        commands=_commands(options.runs, robot, rng),
        start="random",
        truth=Truth(tolerances=tolerances, lateral_friction=_rounded(rng.uniform(0.2, 0.6)) if robot.skid else 0.0),
        noise=EncoderNoise(**noise, steering=0.001 if robot.drive.steered else 0.0),
        train=train,
        validation=validation,
    )


def _commands(runs: int, robot: Robot, rng: np.random.Generator) -> motion.Commands:
    """Lines, curves and turns on the spot that the robot can drive, in all directions that it has."""
    rolling, pivot = motion.straight_and_pivot(robot)
    limit, ways = motion.steering_limit(robot, None), motion.default_directions(robot)
    curvature = math.inf  # 1/m, of the sharpest curve that leaves the steering some room
    if robot.drive.steered and rolling is not None:
        curvature = 0.8 * motion.sharpest_turn(robot, motion.Command(1.0, rolling, 10.0, pivot), limit)
    # Turns that swing and speeds that reverse within a run show what steering and casters do.
    weave, variation = 0.0, motion.STEADY
    if robot.drive.steered or rolling is not None:
        weaves, turns_back = rng.random(2) < 0.5
        weave = _rounded(0.4 * min(_FASTEST_TURN, curvature * _SPEEDS[0])) if weaves else 0.0
        variation = motion.Variation(weave=weave, period=3.0, reversals=int(turns_back))
    drawn: dict[tuple[float, float, float], motion.ListedCommand] = {}
    count = runs // _REPETITIONS
    while len(drawn) < count:
        speed, turn = round(rng.uniform(*_SPEEDS), 2), float(rng.uniform(0.3, 1.0) * rng.choice([-1.0, 1.0]))
        direction = float(rng.choice(ways if rolling is not None else np.arange(0.0, 360.0, 15.0)))
        kinds = rng.random(2)
        if kinds[0] < _SPINS and math.isinf(curvature):
            speed, direction, turn = 0.0, 0.0, 2 * _FASTEST_TURN * turn
        else:
            turn *= (min(_FASTEST_TURN, curvature * speed) - weave) * (kinds[1] < _CURVES)
        number, turn = len(drawn), round(turn, 2) + 0.0  # + 0.0: never -0.0
        drawn[speed, direction, turn] = motion.ListedCommand(
            speed=speed,
            direction_deg=direction,
            turn_rate=turn,
            duration=round(2 * rng.uniform(5.0, 9.0)) / 2,
            repetitions=runs // count + (number < runs % count),
        )
    return motion.Commands(listed=tuple(drawn.values()), ramp=0.5, variation=variation)
