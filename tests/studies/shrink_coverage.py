"""Coverage of the printed 95 % intervals of shrunk and of kept calibrations, for seven classes of robots.

    python tests/studies/shrink_coverage.py --out coverage.jsonl --sets 1000 [--robots skid] [--table]
    python tests/studies/shrink_coverage.py --out slip.jsonl --slip 5

One line of JSON a set, added as it comes: run again with the same file, and it goes on where it was.

The simulation shares nothing with the package: wheel equations stand here, and every run is one exact arc. Each set is
a robot of its own. About its drawing its true geometry spreads by what data sheets and the literature say, and not by
the prior that shrinkage assumes (fit/prior.py). Standard deviations, if not said otherwise:

- all: the radius of a wheel 0.5 %, of all wheels together 1 % (load, pressure);
- differential: the track 1 %;
- skid: a track that is effectively 1.2 to 2 times as wide, uniform (Mandow et al., IROS 2007), and a centre of turning
  2 cm ahead of or behind the middle;
- omni, mecanum: the place of a wheel 3 mm, the angle of its axle or rollers 0.5 degrees, and a share of 2 % of each
  of the three motions that rollers lose;
- tricycle, car, swerve: the place of a wheel 3 mm, the zero of a driven wheel's steering angle 0.5 degrees; of tricycle
  and car the tracked point 3 cm along x and y, and 1 degree of its heading.

Eight commands are driven, three times each, for 4 s. The reference poses of a run, the start too, are off by 2 mm and
3 mrad each, and all together by 2 mm and 2 mrad. Every run slips by 0.1 % ahead and aside and by 0.2 % in turns, which
--slip multiplies.

What is counted: elements of a row that have an interval, and the row along its own motion (x ahead, y aside, the turn
on the spot), with the elements' mean quantile of Student's t. Intervals are said to hold if the design is right along
what no command drives; there the truth is taken as designed. A set counts as one trial, however many elements it has.
Holm's test over all rows asks whether the coverage is within 93 and 97 %.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, binomtest

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.fit.calibrate import calibrate
from omnibench.fit.span import Unidentified
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Robot

Array = NDArray[np.float64]

ANSWERS: tuple[Unidentified, ...] = ("shrink", "keep")
ROWS = ("x", "y", "turn")
PERIOD, SAMPLES, EVERY = 0.2, 20, 4  # s, samples of a run, samples between reference poses
REPETITIONS = 3
SLIP = np.array([0.001, 0.001, 0.002])  # of the motions ahead, aside and in turns, each run
WHITE, OF_RUN = np.array([0.002, 0.002, 0.003]), np.array([0.002, 0.002, 0.002])  # m, m, rad
DRIVEN = 0.1  # share of the strongest direction of drive signals: what is driven less keeps the design
WANTED = (0.93, 0.97)

RADIUS = 0.05  # m
CORNERS = {"fl": (0.2, 0.15), "fr": (0.2, -0.15), "rl": (-0.2, 0.15), "rr": (-0.2, -0.15)}  # m
ROLLERS = {"fl": 45.0, "fr": -45.0, "rl": -45.0, "rr": 45.0}  # degrees
ANGLES = {"a": 60.0, "b": 180.0, "c": 300.0}  # degrees
LENGTH, HALF_TRACK, REACH = 0.5, 0.15, 0.2  # m: wheelbase, half a track, distance of omni wheels
# Twists of the commands, m/s, m/s, rad/s: of robots that cannot move aside, and of those that can.
AHEAD = np.array(
    [
        [0.3, 0, 0],
        [-0.3, 0, 0],
        *([v, 0, w * side] for v, w in ((0.3, 0.4), (0.2, 0.6), (-0.2, 0.5)) for side in (1, -1)),
    ]
)
_DIRECTIONS, _TURNS = np.arange(8) * math.pi / 4, np.array([0.0, 0.5, -0.5, 0.3, 0.0, -0.5, 0.5, -0.3])
ASIDE = np.column_stack([0.3 * np.cos(_DIRECTIONS), 0.3 * np.sin(_DIRECTIONS), _TURNS])


@dataclass(frozen=True)
class TrueRobot:
    """A robot as it is, not as drawn.

    measured: wheel rates (rad/s) and steering angles (rad) for a twist (m/s, m/s, rad/s) of its wheels. tracked (3, 3):
    the twist of the tracked point by that of the wheels.
    """

    measured: Callable[[Array], tuple[list[float], list[float]]]
    tracked: Array


def radii(count: int, rng: np.random.Generator) -> Array:
    """True radii of wheels, m."""
    return RADIUS * (1 + 0.01 * rng.standard_normal()) * (1 + 0.005 * rng.standard_normal(count))


def placed(places: Iterable[tuple[float, float]], rng: np.random.Generator) -> Array:
    """True places (N, 2) of wheels, m."""
    drawn = np.array(list(places))
    return drawn + 0.003 * rng.standard_normal(drawn.shape)


def hub(twist: Array, place: Sequence[float] | Array) -> complex:
    """Velocity of a point of the robot, x + iy, m/s."""
    x, y = place
    return complex(twist[0] - y * twist[2], twist[1] + x * twist[2])


def seen_from(rng: np.random.Generator, point: float, yaw: float) -> Array:
    """The twist of a tracked point that stands somewhere else than drawn, (3, 3). point, yaw: m and rad, deviations."""
    x, y = point * rng.standard_normal(2)
    angle = yaw * rng.standard_normal()
    cosine, sine = math.cos(angle), math.sin(angle)
    turned = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    return turned @ np.array([[1, 0, -y], [0, 1, x], [0, 0, 1]])


def differential(rng: np.random.Generator) -> TrueRobot:
    left, right = radii(2, rng)
    half = HALF_TRACK * (1 + 0.01 * rng.standard_normal())
    return TrueRobot(lambda t: ([(t[0] - half * t[2]) / left, (t[0] + half * t[2]) / right], []), np.eye(3))


def skid(rng: np.random.Generator) -> TrueRobot:
    wheels, half = radii(4, rng), HALF_TRACK * rng.uniform(1.2, 2)
    centre = np.array([[1, 0, 0], [0, 1, -0.02 * rng.standard_normal()], [0, 0, 1]])
    sides = half * np.array([-1, 1, -1, 1])
    return TrueRobot(lambda t: (((t[0] + sides * t[2]) / wheels).tolist(), []), centre)


def rollers(axes: Array, rolling: Array, places: Array, rng: np.random.Generator) -> TrueRobot:
    """A robot on wheels with rollers, whose axes and directions of rolling (N,) are said in rad."""
    wheels = radii(len(axes), rng)
    axes = axes + math.radians(0.5) * rng.standard_normal(len(axes))

    def measured(twist: Array) -> tuple[list[float], list[float]]:
        along = [(hub(twist, place) * np.exp(-1j * axis)).real for place, axis in zip(places, axes, strict=True)]
        return (np.array(along) / (wheels * np.cos(axes - rolling))).tolist(), []

    return TrueRobot(measured, np.diag(1 + 0.02 * rng.standard_normal(3)))


def omni(rng: np.random.Generator) -> TrueRobot:
    angles = np.radians(list(ANGLES.values()))
    rolling = angles + math.pi / 2
    return rollers(rolling, rolling, placed(((REACH * math.cos(a), REACH * math.sin(a)) for a in angles), rng), rng)


def mecanum(rng: np.random.Generator) -> TrueRobot:
    return rollers(-np.radians(list(ROLLERS.values())), np.zeros(4), placed(CORNERS.values(), rng), rng)


def steered(places: Array, wheels: Array, tracked: Array, rng: np.random.Generator) -> TrueRobot:
    """A robot on driven wheels that steer, with zeros that are off."""
    zeros = math.radians(0.5) * rng.standard_normal(len(wheels))

    def measured(twist: Array) -> tuple[list[float], list[float]]:
        velocities = np.array([hub(twist, place) for place in places])
        backwards = np.abs(np.angle(velocities)) > math.pi / 2
        rates = np.abs(velocities) / wheels * np.where(backwards, -1, 1)
        return rates.tolist(), (np.angle(np.where(backwards, -1, 1) * velocities) - zeros).tolist()

    return TrueRobot(measured, tracked)


def tricycle(rng: np.random.Generator) -> TrueRobot:
    return steered(placed([(LENGTH, 0)], rng), radii(1, rng), seen_from(rng, 0.03, math.radians(1)), rng)


def swerve(rng: np.random.Generator) -> TrueRobot:
    return steered(placed(CORNERS.values(), rng), radii(4, rng), np.eye(3), rng)


def car(rng: np.random.Generator) -> TrueRobot:
    rear, front = radii(2, rng), placed([(LENGTH, HALF_TRACK), (LENGTH, -HALF_TRACK)], rng)
    half = HALF_TRACK * (1 + 0.01 * rng.standard_normal())

    def measured(twist: Array) -> tuple[list[float], list[float]]:
        velocities = [hub(twist, place) for place in front]
        angles = [math.atan(velocity.imag / velocity.real) for velocity in velocities]
        return ((twist[0] + half * twist[2] * np.array([-1, 1])) / rear).tolist(), angles

    return TrueRobot(measured, seen_from(rng, 0.03, math.radians(1)))


def drawing(name: str) -> Robot:
    """The robot as drawn."""
    fixed = [
        {"name": side, "type": "fixed", "radius": RADIUS, "x": 0.0, "y": y}
        for side, y in (("left", HALF_TRACK), ("right", -HALF_TRACK))
    ]
    corners = [{"name": corner, "radius": RADIUS, "x": x, "y": y} for corner, (x, y) in CORNERS.items()]
    front = {"type": "steered", "radius": RADIUS, "x": LENGTH}
    wheels: list[dict[str, Any]] = {
        "differential": fixed,
        "skid": [{**wheel, "type": "fixed"} for wheel in corners],
        "omni": [
            {"name": each, "type": "omni", "radius": RADIUS, "distance": REACH, "angle_deg": angle}
            for each, angle in ANGLES.items()
        ],
        "mecanum": [{**wheel, "type": "mecanum", "roller_angle_deg": ROLLERS[str(wheel["name"])]} for wheel in corners],
        "tricycle": [{**front, "name": "front", "y": 0.0}, *({**wheel, "measured": False} for wheel in fixed)],
        "car": [
            *fixed,
            *(
                {**front, "name": side, "y": y, "driven": False}
                for side, y in (("fl", HALF_TRACK), ("fr", -HALF_TRACK))
            ),
        ],
        "swerve": [{**wheel, "type": "steered"} for wheel in corners],
    }[name]
    return Robot.model_validate({"name": name, "wheels": wheels, **({"skid": True} if name == "skid" else {})})


CLASSES: dict[str, Callable[[np.random.Generator], TrueRobot]] = {
    "differential": differential,
    "skid": skid,
    "omni": omni,
    "mecanum": mecanum,
    "tricycle": tricycle,
    "car": car,
    "swerve": swerve,
}


def signals(name: str, rates: Sequence[float], angles: Sequence[float]) -> list[float]:
    """The drive signals (M,) of wheels, of which a twist is a linear function."""
    if name == "car":
        mean, ahead = sum(rates) / 2, np.tan(angles) / (LENGTH + np.array([HALF_TRACK, -HALF_TRACK]) * np.tan(angles))
        return [mean, mean * LENGTH * float(ahead.mean()), rates[1] - rates[0]]
    if not angles:
        return list(rates)
    return [part for rate, a in zip(rates, angles, strict=True) for part in (rate * math.cos(a), rate * math.sin(a))]


def simulated(name: str, seed: int, repetitions: int = REPETITIONS, slip: float = 1.0) -> tuple[Dataset, Array, Array]:
    """Recordings of a robot; its true matrix (3, M), as drawn along what they do not drive; its motions (3, M).

    Motions are directions of drive signals, of length one; zero for a motion that the robot cannot make.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    truth, robot = CLASSES[name](rng), drawing(name)
    slides = name in ("omni", "mecanum", "swerve")
    commands = ASIDE if slides else AHEAD
    runs, driven, moved = [], [], []
    for number, command in enumerate(commands):
        rates, angles = truth.measured(command)
        driven.append(signals(name, rates, angles))
        moved.append(truth.tracked @ command)
        for repetition in range(repetitions):
            stamps = np.linspace(0.0, PERIOD * SAMPLES, SAMPLES // EVERY + 1)
            poses = arc(truth.tracked @ (command * (1 + slip * SLIP * rng.standard_normal(3))), stamps)
            poses += OF_RUN * rng.standard_normal(3) + WHITE * rng.standard_normal(poses.shape)
            runs.append(
                Trajectory(
                    f"{number}-{repetition}", "train", PERIOD * np.arange(1, SAMPLES + 1), np.tile(rates, (SAMPLES, 1)),
                    stamps, poses, command=str(number), repetition=repetition, session="s",
                    steering=np.tile(angles, (SAMPLES, 1)) if angles else None,
                )
            )  # fmt: skip
    dataset = make_dataset(name, robot, PERIOD, runs, simulated=True)
    design = robot.inverse_kinematic_matrix
    _, strengths, directions = np.linalg.svd(np.array(driven), full_matrices=False)
    strong = directions[strengths > DRIVEN * strengths[0]]
    beside = np.array(moved) - np.array(driven) @ design.T
    matrix = design + np.linalg.lstsq(np.array(driven) @ strong.T, beside, rcond=None)[0].T @ strong
    motions = np.linalg.lstsq(commands, np.array(driven), rcond=None)[0]  # of a motion of one: signals are linear in it
    inside = motions @ strong.T @ strong
    return dataset, matrix, inside / np.maximum(np.linalg.norm(inside, axis=1, keepdims=True), 1e-12)


def arc(twist: Array, times: Array) -> Array:
    """Poses (K, 3) of a robot that drives with a constant twist from the origin, in closed form."""
    heading = twist[2] * times
    chord = (np.exp(1j * heading) - 1) / (1j * twist[2]) if abs(twist[2]) > 1e-9 else times
    path = complex(twist[0], twist[1]) * chord
    return np.column_stack([path.real, path.imag, heading])


@dataclass(frozen=True)
class Row:
    """One answer to one set: errors over half-widths of the intervals of each row's elements, and of its motion.

    errors: of the motions, over the row's largest element. source: of the intervals, or why there are none.
    """

    robot: str
    answer: str
    seed: int
    elements: Sequence[Sequence[float]]
    motions: Sequence[float | None]
    errors: Sequence[float]
    source: str

    def hits(self, row: int, kind: str) -> float | None:
        """Share of a row's intervals that hold the truth, or whether its motion's does; None where none is printed."""
        if kind == "motion":
            ratio = self.motions[row]
            return None if ratio is None else float(ratio <= 1)
        return float(np.mean(np.array(self.elements[row]) <= 1)) if self.elements[row] else None


def covered(name: str, answer: Unidentified, seed: int, repetitions: int = REPETITIONS, slip: float = 1.0) -> Row:
    """Calibrate one set and compare its intervals with the truth."""
    dataset, truth, motions = simulated(name, seed, repetitions, slip)
    run = calibrate(dataset, unidentified=answer, seed=seed)
    off = run.calibration.matrix_array - truth
    errors = (np.sum(off * motions, axis=1) / dataset.robot.row_scales).round(6).tolist()
    known = run.uncertainty
    if known is None:
        return Row(name, answer, seed, ((), (), ()), (None, None, None), errors, "; ".join(run.warnings))
    reach = (known.intervals.high - known.intervals.low) / 2
    elements: list[list[float]] = []
    along: list[float | None] = []
    for row in range(3):
        printed = reach[row] > 0  # not of what the design rules out, and not where none is printed
        elements.append((np.abs(off[row])[printed] / reach[row][printed]).round(4).tolist())
        covariance = known.covariance.reshape(3, off.shape[1], 3, off.shape[1])[row, :, row]
        deviation = math.sqrt(max(float(motions[row] @ covariance @ motions[row]), 0.0))
        if deviation < 1e-12 or not printed.all():
            along.append(None)
            continue
        quantile = float(np.mean(reach[row] / known.standard_deviations[row]))
        along.append(round(abs(float(off[row] @ motions[row])) / (quantile * deviation), 4))
    return Row(name, answer, seed, elements, along, errors, known.source)


def both_answers(name: str, seed: int, repetitions: int, slip: float) -> list[Row]:
    """Both answers to one set."""
    return [covered(name, answer, seed, repetitions, slip) for answer in ANSWERS]


def read_rows(path: Path) -> list[Row]:
    """The rows of a file, none if it is not there; a last line that was cut off is left out."""
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [Row(**json.loads(line)) for line in lines]


def carry_out(
    missing: Sequence[tuple[str, int]], path: Path, repetitions: int, slip: float, workers: int
) -> Iterator[Row]:
    """Calibrate sets and add their rows to the file at once."""
    written = path.read_bytes() if path.exists() else b""
    path.write_bytes(written[: written.rfind(b"\n") + 1])
    with one_thread(), ProcessPoolExecutor(workers) as pool, path.open("a") as file:
        for done in as_completed([pool.submit(both_answers, *one, repetitions, slip) for one in missing]):
            rows = done.result()
            file.write("".join(json.dumps(asdict(row)) + "\n" for row in rows))
            file.flush()
            yield from rows


def chance(hits: int, sets: int) -> float:
    """p value (two-sided, exact) of a coverage within WANTED."""
    low, high = WANTED
    return float(min(1.0, 2 * binom.cdf(hits, sets, low), 2 * binom.sf(hits - 1, sets, high)))


def holm(chances: Sequence[float]) -> list[float]:
    """p values after Holm (Scand. J. Stat. 6:65, 1979)."""
    order = np.argsort(chances)
    scaled = np.array(chances)[order] * np.arange(len(chances), 0, -1)
    adjusted = np.empty(len(chances))
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return adjusted.tolist()


def table(rows: Iterable[Row]) -> Iterator[str]:
    """A line for every robot, answer, row and kind of interval: share that holds the truth, Clopper-Pearson, Holm's p.

    error: root mean square of the motion's, % of the row's largest element. without: sets that print none in that row.
    """
    rows = list(rows)
    lines, chances = [], []
    for name in CLASSES:
        for answer in ANSWERS:
            some = [row for row in rows if (row.robot, row.answer) == (name, answer)]
            for index, label in enumerate(ROWS):
                for kind in ("elements", "motion"):
                    shares = [hit for row in some if (hit := row.hits(index, kind)) is not None]
                    if not shares:
                        continue
                    hits = round(sum(shares))
                    ends = binomtest(hits, len(shares)).proportion_ci(0.95, "exact")
                    without = len(some) - len(shares)
                    error = math.sqrt(np.mean(np.square([row.errors[index] for row in some])))
                    chances.append(chance(hits, len(shares)))
                    lines.append(
                        f"{name:13s}{answer:7s} {label:5s}{kind:9s} {len(shares):5d} {100 * np.mean(shares):6.1f} "
                        f"({100 * ends.low:5.1f} to {100 * ends.high:5.1f}) {100 * error:7.3f} {without:5d}"
                    )
    yield f"{'':35s} sets     %  (95 %, exact)      error without  p (Holm)"
    yield from (f"{line}  {p:9.2g}" for line, p in zip(lines, holm(chances), strict=True))


def main() -> None:
    """Calibrate the sets that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--robots", nargs="*", default=list(CLASSES))
    parser.add_argument("--repetitions", type=int, default=REPETITIONS, help="of every command")
    parser.add_argument("--slip", type=float, default=1.0, help="of every run, as a multiple of the above")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="only print the table")
    arguments = parser.parse_args()
    rows = read_rows(arguments.out)
    if not arguments.table:
        done = {(row.robot, row.seed) for row in rows}
        missing = [
            (name, seed) for seed in range(arguments.sets) for name in arguments.robots if (name, seed) not in done
        ]
        rows += carry_out(missing, arguments.out, arguments.repetitions, arguments.slip, arguments.workers)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
