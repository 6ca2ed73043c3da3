"""References that the sensors of a recording give each of its runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.importers.rosbag.bag import Bag, Topic
from omnibench.data.importers.rosbag.message_streams import Stamps
from omnibench.data.importers.rosbag.rosbag_options import RosbagOptions
from omnibench.data.importers.rosbag.sensors.inertial import Inertial, read_inertial
from omnibench.data.importers.rosbag.sensors.satellite_fixes import Fixes, read_fixes
from omnibench.data.importers.rosbag.topic_choice import FIX
from omnibench.data.importers.runs.measured_references import measured_as
from omnibench.data.importers.runs.rests import find_rests
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.data.references.run_references import Reference, References
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

_LONGEST_GAP = 0.3  # s between messages, across which no angle is counted; chosen
_LEAST_SPAN = 0.05  # s; a turn over less tells nothing


@dataclass(frozen=True, eq=False)
class SensorReferences:
    """Fixes and inertial messages of a recording, with the stamp, ns, that its times count from.

    bias: rate of turn, rad/s, that each gyro shows at rest. bias_sigma: largest standard deviation of these, rad/s.
    """

    fixes: Sequence[Fixes]
    inertial: Sequence[Inertial]
    origin: int
    options: RosbagOptions
    bias: Sequence[float]
    bias_sigma: float = 0.0

    @property
    def stamps(self) -> list[Stamps]:
        """Stamps of the messages of each topic, ns."""
        return [*(fixes.stamps for fixes in self.fixes), *(inertial.stamps for inertial in self.inertial)]

    def without_bias(self, samples: WheelSamples, least_rest: float, still: float, place: str) -> SensorReferences:
        """The sensors with the gyros' offsets, seen while the wheels rest for ``least_rest`` s (see ``find_rests``).

        White noise of a rate leaves its mean over a rest of T s unknown by the noise over sqrt(T). DataError: there is
        no rest, and ``gyro_offset_deg`` is not given.
        """
        rests = [rest for part in samples.stretches() for rest in find_rests(*samples.edges(part), least_rest, still)]
        offsets, sigmas = [], [0.0]
        for inertial in self.inertial:
            times = self._times(inertial.stamps)
            resting = np.zeros(len(times), dtype=bool)
            for begin, end in rests:
                resting |= (times >= begin) & (times <= end)
            if inertial.headings is None:
                sigmas.append(self._bias_sigma(float(resting.sum() * np.median(np.diff(times))), place))
            offsets.append(float(inertial.rates[resting].mean()) if resting.any() else 0.0)
        return replace(self, bias=offsets, bias_sigma=max(sigmas))

    def _bias_sigma(self, rested: float, place: str) -> float:
        """Standard deviation, rad/s, of a gyro's offset that was seen for some time, s."""
        if rested > 0:
            return math.radians(self.options.gyro_noise_deg) / math.sqrt(rested)
        if self.options.gyro_offset_deg is None:
            raise DataError(
                f"{place}: the robot never rests, so that nothing tells the gyro's offset; let it stand for some "
                "seconds, or say how large the offset may be, a standard deviation in deg/s: --set gyro_offset_deg=0.5"
            )
        return math.radians(self.options.gyro_offset_deg)

    def of_run(self, zero: float, end: float, *, start_known: bool) -> References | None:
        """The references of a run from the time ``zero`` on, for ``end`` s; None if there are none.

        start_known: its start pose is known in the frame of fixes and headings.
        """
        found: list[Reference] = []
        for fixes in self.fixes:
            times = self._times(fixes.stamps) - zero
            found += [
                Reference("position", _pair(fixes.positions[row]), _pair(fixes.sigmas[row]), float(times[row]))
                for row in self._one_a_period(times, end)
            ]
        for inertial, bias in zip(self.inertial, self.bias, strict=True):
            times = self._times(inertial.stamps) - zero
            if inertial.headings is not None and inertial.sigmas is not None:
                found += [
                    Reference("heading", float(inertial.headings[row]), float(inertial.sigmas[row]), float(times[row]))
                    for row in self._one_a_period(times, end)
                ]
            else:
                found += self._turns(times, inertial.rates - bias, end)
        if not found:
            return None
        references = References.of(found, end, start_known=start_known, rate_sigma=self.bias_sigma)
        metres = self.options.model_copy(update={"position_unit": "m"})
        return measured_as(references, metres, 1.0)

    def _times(self, stamps: Stamps) -> Array:
        """Times (K,) of stamps, s, by the clock of the wheels as the options say."""
        times: Array = (stamps - self.origin) / 1e9
        return times + (self.options.pose_time_offset + self.options.pose_time_drift * (times - times[0]))

    def _one_a_period(self, times: Array, end: float) -> list[int]:
        """Indices of the first of the times in each period of a run."""
        inside = np.flatnonzero((times >= 0) & (times <= end))
        _, first = np.unique(np.floor(times[inside] / self.options.reference_period), return_index=True)
        return [int(row) for row in inside[first]]

    def _turns(self, times: Array, rates: Array, end: float) -> list[Reference]:
        """Angles turned in each period; beside the offset's, their errors are independent: a rate's white noise."""
        angles = np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2 * np.diff(times))])
        begin, last = max(0.0, float(times[0])), min(end, float(times[-1]))
        if last - begin < _LEAST_SPAN:
            return []
        count = max(1, round((last - begin) / self.options.reference_period))
        edges = np.linspace(begin, last, count + 1)
        at = np.interp(edges, times, angles)
        sigma = math.radians(self.options.gyro_noise_deg) * math.sqrt((last - begin) / count)
        gaps = np.flatnonzero(np.diff(times) > _LONGEST_GAP)
        seen = [not ((times[gaps] < edges[row + 1]) & (times[gaps + 1] > edges[row])).any() for row in range(count)]
        return [
            Reference("turn", float(at[row + 1] - at[row]), sigma, float(edges[row + 1]), float(edges[row]))
            for row in np.flatnonzero(seen).tolist()
        ]


def read_sensors(
    bag: Bag, topics: Sequence[Topic], origin: int, options: RosbagOptions, warnings: list[str]
) -> SensorReferences | None:
    """The sensors of some topics; None without any. What is left out is added to ``warnings``. DataError."""
    if not topics:
        return None
    sigma = None if options.heading_sigma_deg is None else math.radians(options.heading_sigma_deg)
    fixes = [read_fixes(bag, topic, options.fix_sigma, warnings) for topic in topics if topic.type == FIX]
    inertial = [
        read_inertial(bag, topic, sigma, options.imu == "gyro", warnings) for topic in topics if topic.type != FIX
    ]
    return SensorReferences(fixes, inertial, origin, options, [0.0] * len(inertial))


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
