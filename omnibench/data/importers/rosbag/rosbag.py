"""Importer of ROS recordings: MCAP files, rosbag2 folders and ROS 1 bags."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.rosbag.bag import ODOMETRY, TRANSFORMS, find_bags
from omnibench.data.importers.rosbag.bag_recording import cut_into_runs, read_recording
from omnibench.data.importers.rosbag.rosbag_options import RosbagOptions
from omnibench.data.importers.rosbag.scan_stream import RunScans, gather_scans
from omnibench.data.importers.runs.recorded_streams import RecordedStreams, by_one_clock
from omnibench.data.splits import complete
from omnibench.errors import DataError
from omnibench.registry import importers
from omnibench.robot.model import OdometryModel


@importers.register("rosbag")
class Rosbag(Importer):
    """ROS recordings: MCAP, rosbag2 (sqlite3 and mcap) and ROS 1, with wheels and reference poses or laser scans.

    The source is a bag, or a folder of bags; ``robot`` (a YAML file or a mapping) is the only option that must be
    given. Wheels are a sensor_msgs/JointState, poses a geometry_msgs/PoseWithCovarianceStamped, PoseStamped or
    TransformStamped. A bag with several of them lists them, and ``wheel_topic`` and ``pose_topic`` choose. Joints are
    those called like the wheels (``a``, ``wheel_a``, ``a_wheel_joint``), or ``joints`` names them in the robot's order;
    those that steer have "steer" in their names, too, or ``steering_joints`` names them. ``joint_signs: [-1, 1, 1]``
    turns a wheel round; the sense of a positive rate is in ``omnibench guide conventions``.

    Named topics may hold std_msgs numbers, too: of all wheels in an array, or each wheel by its own topic in a list;
    these are interpolated at the stamps of the first, as steering angles of another topic are. A nav_msgs/Odometry or
    a tf (``pose_frames: [world, robot]``) is a reference only when named, and refused where it is made of the wheels.

    references: a sensor_msgs/NavSatFix gives positions, east and north of its first fix, an Imu headings (orientation)
    or turned angles (its rates about z, without their mean at rest), one each ``reference_period``. They are taken
    where a bag has neither poses nor scans, or where ``references`` names them.

    scans: those of a sensor_msgs/LaserScan (``scan_topic``; ``scans: false`` leaves them out) go into the data set.
    Where the scanner is mounted comes from /tf_static or from ``scanner_mount: {x, y, yaw}`` (m, rad). A bag with scans
    and without reference poses (odometry does not count as one) gets them from its scans by SLAM, with the options in
    ``slam``; each run then begins at (0, 0, 0).

    times: the stamps of the headers, of all topics by one clock; when a message was recorded matters for the topics in
    ``recorded_stamps`` only.
    Messages recorded late are sorted; those without a stamp, with a stamp that was there or with values that are not
    finite are left out. Warnings say how many. Plain numbers have no stamps but the times of recording. Positions are
    preferred: their differences are exact however many samples were lost. Velocities count as the mean since the
    message before.

    cut: at ``rests`` (each run keeps a little of the rest at both ends, and begins and ends at a reference pose there);
    by a ``topic`` (a message of ``cut_topic`` begins a run, and a String says which command is driven); in ``windows``
    of ``window`` s; or ``none``. Where samples are missing while the wheels turn, or the positions begin anew, a run
    ends in any case, and another session begins. Poses are as recorded; t = 0 is a run's first pose.

    Splits: ``train`` and ``validation`` are patterns of run names (``00*``, ``*-forward``); with one of them all other
    runs go to the other side, with both the runs in neither are left out, with none every second run of a command
    validates. A run is called by its number, before it the bag (``day1/003``) if there are several, and after it the
    command (``003-forward``) if there is one.
    """

    Options = RosbagOptions
    options: RosbagOptions

    def read(self, source: Path) -> Dataset:
        """All bags at or below ``source``; DataError names the bag, the topic and the message of what is wrong."""
        bags = find_bags(source)
        warnings: list[str] = []
        runs: list[Trajectory] = []
        scans: dict[str, RunScans] = {}
        unreferenced: list[Path] = []
        doubtful: set[str] = set()
        recordings = [read_recording(path, name, self.options, warnings) for name, path in bags.items()]
        if all(recording.referenced for recording in recordings):
            streams = [RecordedStreams(each.name, each.place, each.samples, each.poses) for each in recordings]
            matched = by_one_clock(streams, self.options, warnings)
            recordings = [replace(each, poses=one.reference) for each, one in zip(recordings, matched, strict=True)]
        for (name, path), recording in zip(bags.items(), recordings, strict=True):
            if not recording.referenced:
                unreferenced.append(path)
            elif recording.reference is not None and recording.reference.type in (ODOMETRY, TRANSFORMS):
                doubtful.add(recording.reference.name)
            recorded_runs, left_out = cut_into_runs(recording, self.options, alone=len(bags) == 1)
            warnings += left_out
            for run in recorded_runs:
                named = replace(run.trajectory, id=f"{name}/{run.trajectory.id}") if len(bags) > 1 else run.trajectory
                runs.append(named)
                if run.scans is not None:
                    scans[named.id] = run.scans
        if not runs:
            raise DataError(f"{warnings[-1]}; nothing is left")
        if 0 < len(unreferenced) < len(bags):
            raise DataError(
                f"{unreferenced[0]}: no topic holds reference poses, as it does in other bags; import the bags without "
                "reference poses apart"
            )
        if unreferenced:
            # The design model's odometry, from (0, 0, 0) on, in the place of reference poses.
            design = OdometryModel.of_design(self.options.robot, "arc")
            if not self.options.robot.drive.direct:
                runs = [replace(run, drive=self.options.robot.drive) for run in runs]
            poses = design.poses([run.log(run.pose_times) for run in runs])
            runs = [replace(run, poses=pose) for run, pose in zip(runs, poses, strict=True)]
        chosen = self.options.divided(complete(runs))
        dataset = self.options.dataset(
            chosen, gather_scans({run.id: scans[run.id] for run in chosen if run.id in scans})
        )
        if doubtful and (residual := follows_the_wheels(dataset.trajectories)) is not None:
            raise DataError(
                f"{source}: {', '.join(sorted(doubtful))} is the robot's own odometry: some matrix makes its headings "
                f"of the wheels to {residual:.1g} rad a second, and no error can show; --set pose_topic=NAME of an "
                "independent reference (motion capture, SLAM), or record one"
            )
        if unreferenced:  # the data set is checked once more when it has its poses
            return replace(dataset, referenced=False, warnings=tuple(warnings))
        return replace(dataset, warnings=(*warnings, *dataset.warnings))
