"""Importer plug-in: the Festo Robotino v2 recordings of the research-wheel-slippage project.

It is loaded from any folder that the config or ``--plugins`` names.

How wheel order and signs were found. Every run starts with a commanded motion: motor set speeds of (-34.64, 0, 34.64)
rad/s for 0.1 m/s along x and (20, -40, 20) along y are the wheel equation (-sin d, cos d, R) / r at d = 60, 180, 300
degrees, r = 0.04 m, times the gear of 16, so motors 1, 2, 3 stand there and a positive speed drives the robot
counter-clockwise, as omnibench has it. Ticks count with the same sign as the set speeds. Of all 48 orders and signs of
the three wheels this one fits the camera's final poses best (tests/plugins/test_robotino.py).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from pydantic import Field

from omnibench.data.clock_matching import median_period
from omnibench.data.dataset import Dataset, Trajectory, every_second, make_dataset
from omnibench.data.delimited import read_numbers
from omnibench.data.importer import Importer
from omnibench.data.splits import Names, divided
from omnibench.errors import DataError
from omnibench.registry import Options, importers
from omnibench.robot.kinematics import Robot, Wheel

GEAR = 16
TICKS_PER_MOTOR_TURN = 2000
METRES_PER_PIXEL = (1.84046e-3, 1.83716e-3)  # m, along the camera's x and y

ROBOT = Robot(
    name="festo_robotino_v2",
    wheels=tuple(
        Wheel(name=str(number), radius=0.040, distance=0.125, angle=math.radians(angle), roller_angle=0.0)
        for number, angle in ((1, 60), (2, 180), (3, 300))
    ),
)
_COMMAND = ("xsetspeed", "ysetspeed", "setvel")
_SET_SPEEDS = ("m1setvel", "m2setvel", "m3setvel")
_TICKS = ("m1pos", "m2pos", "m3pos")
_CAMERA = ("xpos", "ypos", "ang")


class RobotinoOptions(Options):
    """Split and name of the data set."""

    train: Names = Field((), description="patterns of run names (table_surface/exp0*) that train")
    validation: Names = Field((), description="patterns of run names that validate; default: every second direction")
    name: str = Field("robotino", min_length=1, description="name of the data set")


@importers.register("robotino")
class Robotino(Importer):
    """Festo Robotino v2, three omni wheels under an overhead camera: one file a run, one direction each.

    The source is any folder above ``exp*.csv`` (separator ``;``, three header lines). Wheel angles come from cumulative
    motor ticks (2000 a turn, gear 16); world frame X = -y, Y = -x of the camera's pixels, heading = its angle (deg).
    The camera's scale cannot be distinguished from the wheel radius, and without commanded rotation the lever arm is
    not identified. Repetitions are runs of the same speed and direction within one folder (surface). Every second
    direction validates, unless ``train`` or ``validation`` name runs.
    """

    Options = RobotinoOptions
    options: RobotinoOptions

    def read(self, source: Path) -> Dataset:
        """All runs under ``source``. DataError names the file, the row and the mistake."""
        files = sorted(source.resolve().rglob("exp*.csv"))
        if not files:
            raise DataError(f"{source}: no exp*.csv below it; name a folder of the research-wheel-slippage data sets")
        runs = sorted((_read_run(file) for file in files), key=lambda run: (run.session, run.v, run.alpha, run.id))
        commands = list(dict.fromkeys(run.command for run in runs))
        sides = dict(zip(commands, every_second([0] * len(commands)), strict=True))
        by_direction = [sides[run.command] for run in runs]
        return make_dataset(
            self.options.name,
            ROBOT,
            median_period([run.times for run in runs]),
            divided(runs, self.options.train, self.options.validation, otherwise=by_direction),
            description="Festo Robotino v2, motor encoders and an overhead camera, translation only",
            source="public GitHub repository BrOleg5/research-wheel-slippage, commit b4303b4c",
            licence="Apache-2.0",
        )


def _read_run(file: Path) -> Trajectory:
    table = read_numbers(file, ("t", *_COMMAND, *_SET_SPEEDS, *_TICKS, *_CAMERA), separator=";", header_lines=3)
    if len(table) < 2:
        raise DataError(f"{file}: a run needs two rows or more")
    times = (table.increasing("t") - table.column("t")[0]) * 1e-3
    angles = table.columns(_TICKS) * (2 * math.pi / (TICKS_PER_MOTOR_TURN * GEAR))
    pixels_x, pixels_y, degrees = table.columns(_CAMERA).T
    vx, vy, omega = (float(value) for value in np.median(table.columns(_COMMAND), axis=0))
    v, alpha = round(math.hypot(vx, vy), 6), round(math.degrees(math.atan2(vy, vx)), 3) % 360
    surface = file.parent.name
    return Trajectory(
        id=f"{surface}/{file.stem}",
        split="train",
        times=times[1:],
        rates=np.diff(angles, axis=0) / np.diff(times)[:, None],
        pose_times=times,
        poses=np.column_stack([-pixels_y * METRES_PER_PIXEL[1], -pixels_x * METRES_PER_PIXEL[0], np.radians(degrees)]),
        command=f"{surface}_v{v:g}_a{alpha:g}_w{omega:g}",
        session=surface,
        v=v,
        alpha=math.radians(alpha),
        omega=omega,
        duration=float(times[-1]),
        angles=angles[1:],
        targets=table.columns(_SET_SPEEDS)[1:] / GEAR,
    )
