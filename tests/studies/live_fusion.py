"""What fusing SLAM poses at their own time is worth: the apr02 recording (simulated), run after run as one drive.

    python tests/studies/live_fusion.py [--split train]

Poses come 250 ms apart and 200 ms late. Position RMSE against the simulated truth, at every wheel sample, of odometry
with the design matrix, of calibrated odometry, of poses fused at their own time, of the same poses fused without any
delay, and of late poses taken for new ones. No network: the tracker is given the messages in the order of arrival.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from omnibench.live.drive import (
    ConcatenatedDrive,
    ReplayConfig,
    concatenate_recording,
    concatenated_truth,
    load_recording,
)
from omnibench.live.fusion import FusionSettings
from omnibench.live.replay import ReplayMessages
from omnibench.live.tracker import RobotTracker
from omnibench.live.wire import JOINT_STATE, POSE_ESTIMATE, JointState, PoseEstimate
from omnibench.robot.calibration import Calibration, read_calibration
from omnibench.robot.model import OdometryModel

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
ORIGIN = 1_800_000_000_000_000_000


def fused(
    drive: ConcatenatedDrive, calibration: Calibration, delay: float, *, as_new: bool = False
) -> tuple[np.ndarray, str]:
    """Filtered poses (n, 3) at the wheel samples, and what was counted."""
    tracker = RobotTracker("apr02", calibration, fusion=FusionSettings())
    config = ReplayConfig.model_validate({"slam": {"delay": delay, "jitter": 0.0, "period": 0.25}})
    poses, newest = [], ORIGIN
    for event in ReplayMessages(drive, config, noise=calibration.noise).stamped_from(ORIGIN):
        message = event.message
        if isinstance(message, JointState):
            newest = message.stamp
            poses += [
                update.in_map[0]
                for update in tracker.take_wheels(JOINT_STATE.encode(message), event.arrival)
                if update.in_map is not None
            ]
        else:
            stamp = newest if as_new else message.stamp
            late = PoseEstimate(stamp, message.frame, message.pose, message.covariance)
            tracker.take_pose(POSE_ESTIMATE.encode(late), event.arrival)
    counts = tracker.counts
    return np.array(poses), f"{counts.poses} fused, {counts.pose_rejected} rejected, {counts.pose_too_late} too late"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=["train", "validation"])
    split = parser.parse_args().split
    recording = load_recording(CONFIGS / "apr02.yaml")
    calibration = read_calibration(CONFIGS / "apr02_calibration.yaml")
    drive = concatenate_recording(recording, split=split)
    truth = concatenated_truth(drive, recording)

    def error(poses: np.ndarray) -> float:
        known = drive.wheel_times > 1.0  # by then SLAM has said where the robot is
        return float(np.sqrt(np.mean(np.sum((poses - truth)[known, :2] ** 2, axis=1))))

    def of(model: OdometryModel) -> float:
        return error(model.poses([drive.log()])[0])

    theoretical = of(OdometryModel.of_design(calibration.robot, calibration.integration))
    print(f"{len(drive.wheel_times)} samples of {drive.wheel_times[-1]:.0f} s, simulated")
    print(f"odometry, design matrix       {theoretical:8.4f} m")
    print(f"odometry, calibrated          {of(calibration.model):8.4f} m")
    results = {}
    for label, delay, as_new in (
        ("fused, 200 ms late", 0.2, False),
        ("fused, without delay", 0.0, False),
        ("fused as if they were new", 0.2, True),
    ):
        poses, counted = fused(drive, calibration, delay, as_new=as_new)
        results[label] = error(poses)
        print(f"{label:29} {results[label]:8.4f} m   ({counted})")
    late, punctual, naive = results.values()
    print(
        f"ratios: late / design odometry {late / theoretical:.4f} (at most 0.1), "
        f"late / without delay {late / punctual:.3f} (at most 1.3), as new / late {naive / late:.1f}"
    )


if __name__ == "__main__":
    main()
