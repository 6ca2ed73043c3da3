"""Importer of ROS recordings, MCAP files, rosbag2 folders and ROS 1 bags: one recording's streams, cut into runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.rosbag.bag import (
    ODOMETRY,
    TRANSFORMS,
    Bag,
    RosbagOptions,
    Topic,
    find_bags,
    has_sensors,
    joint_topics,
    open_bag,
    pose_topic,
    scan_topic,
    sensor_topics,
)
from omnibench.data.importers.rosbag.message_streams import (
    PoseStream,
    Stamps,
    WheelStream,
    header_stamp,
    read_poses,
    read_wheels,
)
from omnibench.data.importers.rosbag.scan_stream import RunScans, ScanStream, gather_scans, read_scans, read_transforms
from omnibench.data.importers.rosbag.sensor_references import SensorReferences, read_sensors
from omnibench.data.importers.runs.recording_runs import (
    RecordedStreams,
    ReferenceStream,
    Span,
    breaks,
    by_one_clock,
    cut_run,
    departure,
    find_rests,
    from_rest,
    parted,
)
from omnibench.data.importers.wheel_samples import WheelSamples, wheel_samples
from omnibench.data.splits import complete
from omnibench.errors import DataError, one_line
from omnibench.registry import importers
from omnibench.robot.kinematics import Array, interpolated
from omnibench.robot.model import OdometryModel
from omnibench.words import plural


@dataclass(frozen=True)
class Piece:
    """Time span of a run, begin and end in s. moving: how long the robot drives or may drive, s."""

    begin: float
    end: float
    moving: float
    command: str | None = None


@dataclass(frozen=True)
class Cut:
    """An instant (s) at which a run begins, and the command that is driven from then on."""

    time: float
    command: str | None


def between_rests(span: tuple[float, float], rests: Sequence[tuple[float, float]], stamps: Array) -> list[Piece]:
    """The drives between rests, each with a little rest at both ends, from a reference pose to another.

    stamps (K,): stamps of the reference poses, s. Drives on either side of a rest share at most an instant of it.
    """
    edges = [(span[0], span[0]), *rests, (span[1], span[1])]
    if rests and rests[0][0] == span[0]:
        edges = edges[1:]
    if rests and rests[-1][1] == span[1]:
        edges = edges[:-1]
    pieces = []
    for before, after in pairwise(edges):
        begin = departure(before, before[0] > span[0], stamps)
        # The end at a reference pose of the rest, if it has one: a departure with the time reversed.
        end = -departure((-after[1], -after[0]), after[1] < span[1], -stamps[::-1])
        pieces.append(Piece(begin, end, after[0] - before[1]))
    return pieces


def windows(span: tuple[float, float], length: float) -> list[Piece]:
    """Pieces of ``length`` s one after the other; the last may be shorter."""
    begins = np.arange(span[0], span[1], length)
    ends = np.append(begins[1:], span[1])
    return [Piece(float(begin), float(end), float(end - begin)) for begin, end in zip(begins, ends, strict=True)]


def from_cuts(times: Array, angles: Array, cuts: Sequence[Cut], stamps: Array, turned: float) -> list[Piece]:
    """The pieces of a stretch (times and angles as for ``find_rests``) from each cut to the next.

    A piece begins at the last reference pose (``stamps``, s) before its cut if the wheels stood since then, so that
    nothing of the drive is lost. It has the command's name only if the stretch holds the command from its begin.
    """
    pieces = []
    for cut, following in zip(cuts, [*cuts[1:], None], strict=True):
        begin, end = max(cut.time, times[0]), min(following.time, times[-1]) if following else times[-1]
        if end <= begin:
            continue
        whole = begin == cut.time and (following is None or end == following.time)
        earlier = stamps[(stamps <= begin) & (stamps >= times[0])]
        start = float(earlier[-1]) if len(earlier) and _stood(times, angles, earlier[-1], begin, turned) else begin
        pieces.append(Piece(float(start), float(end), float(end - begin), cut.command if whole else None))
    return pieces


def _stood(times: Array, angles: Array, begin: float, end: float, turned: float) -> bool:
    inside = interpolated(np.array([begin, end]), times, angles)
    between = angles[(times >= begin) & (times <= end)]
    return bool((np.ptp(np.vstack([inside, between]), axis=0) <= turned).all())


_SAME_TIME = 1e-9  # s, the resolution of the stamps


@dataclass(frozen=True, eq=False)
class Recording:
    """Content of a bag, in s since ``origin`` (ns), the first wheel message. place: bag and wheel topic, for messages.

    reference: topic of the reference poses; None: poses are zeros at the stamps of the scans. sensors: references of
    other kinds; where there are no poses, either.
    """

    name: str
    place: str
    origin: int
    samples: WheelSamples
    poses: ReferenceStream
    cuts: tuple[Cut, ...]
    scans: ScanStream | None
    reference: Topic | None
    sensors: SensorReferences | None = None

    @property
    def referenced(self) -> bool:
        """True if the bag holds reference poses, or other references."""
        return self.reference is not None or self.sensors is not None


@dataclass(frozen=True, eq=False)
class Run:
    """A run and its scans, where there are any."""

    trajectory: Trajectory
    scans: RunScans | None


def read_recording(path: Path, name: str, options: RosbagOptions, warnings: list[str]) -> Recording:
    """Read one bag; what is left out is added to ``warnings``. DataError, ConfigError."""
    with open_bag(path, options.recorded_stamps) as bag:
        topics = joint_topics(bag, options.wheel_topic, options.steering_topic, bool(options.robot.drive.steered))
        topic = topics.wheels[0]
        scan = scan_topic(bag, options.scan_topic, topic) if options.scans else None
        named = bool(options.references)
        reference = pose_topic(bag, options.pose_topic, topic, scan, sensors=named or has_sensors(bag))
        measured = named or (reference is None and scan is None)
        sensed = sensor_topics(bag, options.references) if measured else ()
        commands = bag.topic(options.cut_topic, "cut_topic") if options.cut_topic else None
        wheels = read_wheels(bag, topics, options, warnings)
        poses = None
        if reference is not None and reference.type == TRANSFORMS:
            poses = read_transforms(bag, reference, options.pose_frames, warnings)
        elif reference is not None:
            poses = read_poses(bag, reference, warnings, sigma=options.pose_sigma)
        cuts = _read_cuts(bag, commands, wheels) if commands else []
        scans = read_scans(bag, scan, options.scanner_mount, warnings) if scan else None
        sensors = read_sensors(bag, sensed, int(wheels.stamps[0]), options, warnings)
    for sensor, stamps in zip(sensed, sensors.stamps if sensors else (), strict=True):
        _check_clocks(path, topic, wheels, "messages", sensor, stamps)
    if reference and poses:
        _check_clocks(path, topic, wheels, "poses", reference, poses.stamps)
    if scan and scans:
        _check_clocks(path, topic, wheels, "scans", scan, scans.stamps)
    if poses is None and sensors is None:
        assert scans is not None  # else a topic of poses is asked for
        poses = PoseStream(scans.stamps, np.zeros((len(scans.stamps), 3)), None)
    place = f"{path}: topic {topic.name}"
    period = float(np.median(np.diff(wheels.readings.times)))
    gap = options.longest_gap or wheels.longest_gap
    samples, losses = wheel_samples(wheels.readings, options, place, period, longest_gap=gap, still=options.still)
    words = []
    if losses.gaps:
        words.append(
            f"{place}: wheel samples are missing {plural(losses.gaps, 'time')} while the wheels turned, "
            f"up to {losses.longest:.3g} s; runs end there"
        )
    warnings.extend(words + losses.in_words(place, "message"))
    origin = int(wheels.stamps[0])
    # Exact to the nanosecond, which a double of unix time is not.
    stream = ReferenceStream.without_poses()
    if poses is not None:
        stream = ReferenceStream((poses.stamps - origin) / 1e9, poses.poses, poses.covariances)
    stream = stream.read_as(options) if reference else stream
    if sensors is not None:
        sensors = sensors.without_bias(samples, options.least_rest, options.still, place)
    return Recording(name, place, origin, samples, stream, tuple(cuts), scans, reference, sensors)


def cut_into_runs(recording: Recording, options: RosbagOptions, *, alone: bool = True) -> tuple[list[Run], list[str]]:
    """The runs of a recording, named by their number, all of split train; and warnings of what is left out.

    alone: the recording is the only one; then one without any rest is warned of, too.
    """
    runs: list[Run] = []
    pieces = short = bare = uncut = driving = 0
    at = breaks(recording.samples, recording.poses, options)
    for number, part in enumerate(recording.samples.stretches(), 1):
        session = recording.name if number == 1 or recording.samples.angles is None else f"{recording.name}#{number}"
        for piece in _unbroken(_pieces(recording, part, options), recording, part, at, options):
            pieces += 1
            if piece is None:
                driving += 1
                continue
            uncut += (piece.begin, piece.end) == (recording.samples.begins[part][0], recording.samples.ends[part][-1])
            if piece.moving < options.least_run:
                short += 1
                continue
            run = _run(recording, part, piece, f"{len(runs) + 1:03d}", session)
            if run is None:
                bare += 1
            else:
                runs.append(run)
    reasons = []
    if short:
        reasons.append(f"{short} shorter than {options.least_run:g} s (least_run)")
    if bare:
        unposed = "references" if recording.sensors else "reference poses" if recording.referenced else "scans"
        reasons.append(f"{bare} with fewer than two {unposed}")
    if driving:
        reasons.append(f"{driving} that never rest (start_at_rest)")
    if reasons:
        return runs, [
            f"{recording.place}: {short + bare + driving} of {plural(pieces, 'drive')} left out: {', '.join(reasons)}"
        ]
    if not runs:
        problem = f"no message of {options.cut_topic} while the wheels were recorded"
        if options.cut == "rests":
            problem = f"the wheels rest all the time (less than {options.rest_rate:g} rad/s, rest_rate)"
        return runs, [f"{recording.place}: {problem}"]
    if alone and options.cut == "rests" and uncut == len(runs):
        advice = f"no rest of {options.least_rest:g} s cuts it; --set cut=topic or cut=windows for more runs"
        return runs, [f"{recording.place}: {advice}"]
    return runs, []


def _pieces(recording: Recording, part: slice, options: RosbagOptions) -> list[Piece]:
    times, angles = recording.samples.edges(part)
    span = (float(times[0]), float(times[-1]))
    if options.cut == "rests":
        rests = find_rests(times, angles, options.least_rest, options.still)
        return between_rests(span, rests, recording.poses.times)
    if options.cut == "topic":
        return from_cuts(times, angles, recording.cuts, recording.poses.times, options.still)
    return windows(span, options.window or span[1] - span[0])


def _unbroken(
    pieces: Sequence[Piece], recording: Recording, part: slice, at: Sequence[Span], options: RosbagOptions
) -> Iterator[Piece | None]:
    """The pieces without gaps and jumps, from rest on if wanted; None for those that never rest."""
    for piece in pieces:
        spans = list(parted((piece.begin, piece.end), at))
        for span in spans:
            begun: Span | None = span
            if options.start_at_rest:
                begun = from_rest(recording.samples, part, span, recording.poses.times)
            moving, command = min(piece.moving, span[1] - span[0]), piece.command if len(spans) == 1 else None
            yield None if begun is None else Piece(*begun, moving, command)


def _run(recording: Recording, part: slice, piece: Piece, number: str, session: str) -> Run | None:
    samples, reference = recording.samples, recording.poses
    within = (samples.begins[part] < piece.end - _SAME_TIME) & (samples.ends[part] > piece.begin + _SAME_TIME)
    # From reference pose to reference pose: one interpolated within a drive would be wrong by the path's bend.
    seen = (reference.times >= piece.begin - _SAME_TIME) & (reference.times <= piece.end + _SAME_TIME)
    whole = Trajectory(
        id=number if piece.command is None else f"{number}-{piece.command}",
        split="train",
        times=samples.ends,
        rates=samples.rates,
        pose_times=reference.times,
        poses=reference.poses,
        command=piece.command,
        session=session,
    )
    cut = cut_run(whole, samples, part.start + np.flatnonzero(within), reference, seen)
    if cut is None:
        return None
    started = cut.zero - float(samples.begins[0 if samples.angles is None else part.start])
    run = replace(cut.trajectory, started_at=started)
    if recording.sensors is not None:
        run = replace(
            run, references=recording.sensors.of_run(cut.zero, float(run.times[-1]), start_known=run.has_poses)
        )
        if run.references is None and not run.has_poses:
            return None
    scans = recording.scans
    end = cut.zero + float(run.times[-1])
    return Run(run, None if scans is None else scans.between(cut.zero, end, recording.origin))


def _read_cuts(bag: Bag, topic: Topic, wheels: WheelStream) -> list[Cut]:
    """Times of a topic's messages, with the text of a String.

    Messages without a header have only the recorder's clock, which is converted by the wheels, whose messages have
    both.
    """
    order = np.argsort(wheels.logged, kind="stable")
    logged, stamps = wheels.logged[order], np.maximum.accumulate(wheels.stamps[order])
    first, origin = int(logged[0]), int(wheels.stamps[0])
    cuts = []
    for record in bag.records(topic):
        stamp = 0 if topic.recorded else header_stamp(record.message)
        if stamp > 0:
            time = (stamp - origin) / 1e9
        else:
            time = float(np.interp(record.logged - first, logged - first, (stamps - origin) / 1e9))
        text = record.message.data if topic.type == "std_msgs/msg/String" and record.message else ""
        cuts.append(Cut(time, one_line(str(text)) or None))
    return sorted(cuts, key=lambda cut: cut.time)


def _check_clocks(path: Path, topic: Topic, wheels: WheelStream, what: str, other: Topic, stamps: Stamps) -> None:
    inside = (stamps >= wheels.stamps[0]) & (stamps <= wheels.stamps[-1])
    if inside.sum() >= 2:
        return
    spans = (f"{times[0] / 1e9:.3f} to {times[-1] / 1e9:.3f} s" for times in (stamps, wheels.stamps))
    shown = " and ".join(f"{named.name} {span}" for named, span in zip((other, topic), spans, strict=True))
    raise DataError(
        f"{path}: no two {what} while the wheels were recorded, by the stamps of their headers ({shown}); both must be "
        f"stamped by one clock, or set recorded_stamps=[{topic.name},{other.name}] to take the times of recording"
    )


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
