"""The section on the data."""

from __future__ import annotations

import numpy as np

from omnibench.compare.report.view import SPLIT_NAMES, DatasetView
from omnibench.data.dataset import SPLITS
from omnibench.report.blocks import Callout, Fact, Facts, Section
from omnibench.report.numbers import count, fixed, listing, significant
from omnibench.robot.kinematics import Array, Wheel


def data_section(view: DatasetView) -> Section:
    """The section about the data: origin, amount, robot, and warnings on reading them."""
    dataset = view.dataset
    trajectories = dataset.trajectories
    durations = np.array([trajectory.end for trajectory in trajectories])
    commands = {trajectory.command for trajectory in trajectories} - {None}
    sessions = {trajectory.session for trajectory in trajectories} - {None}
    split_sizes = [f"{count(len(dataset.split(split)))} {SPLIT_NAMES[split]}" for split in SPLITS]
    wheels = [_wheel(wheel) for wheel in dataset.robot.wheels]
    facts = [
        Fact("Data set", dataset.name, "simulated" if dataset.simulated else ""),
        Fact("Description", dataset.description),
        Fact("Source", dataset.source),
        Fact("Licence", dataset.licence),
        Fact("Trajectories", f"{count(len(trajectories))}: {listing(split_sizes)}"),
        Fact("Commands", count(len(commands)) if commands else "not known"),
        Fact("Sessions", listing(sorted(map(str, sessions))) if sessions else "not known"),
        Fact(
            "Duration",
            f"{_range(durations)} s a run",
            f"wheel samples every {significant(1e3 * dataset.sample_period, 3)} ms",
        ),
        Fact("Robot", dataset.robot.name, "; ".join(wheels)),
        Fact("Odometry", "exact arcs" if view.config.integration == "arc" else "Euler steps, Eq. (1)"),
        Fact("Content (SHA-256)", dataset.hash[:16]),
    ]
    shown_above = " ".join(view.warnings)
    warnings = tuple(warning for warning in dataset.warnings if warning not in shown_above)
    blocks = (
        Facts(tuple(fact for fact in facts if fact.value)),
        Callout("Warnings on reading the data", warnings, "warning"),
    )
    return Section("data", "Data", blocks, about="Where the recordings come from, and what they hold.", folded=True)


def _wheel(wheel: Wheel) -> str:
    """A wheel's design values: its place as it was given, angles in degrees."""
    lengths = (("radius", wheel.radius), ("distance", wheel.distance), ("x", wheel.x), ("y", wheel.y))
    angles = (("angle", wheel.angle), ("rollers", wheel.roller_angle or None))
    parts = [
        *([wheel.type] if wheel.type else []),
        *(f"{name} {value:g} m".replace("-", "−") for name, value in lengths if value is not None),
        *(f"{name} {fixed(np.degrees(value), 1)}°" for name, value in angles if value is not None),
        *([] if wheel.driven else ["not driven"]),
        *([] if wheel.measured else ["not measured"]),
    ]
    return f"{wheel.name}: {', '.join(parts)}"


def _range(values: Array) -> str:
    low, high = (significant(float(value), 3) for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"
