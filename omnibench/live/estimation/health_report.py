"""Health report: a robot's status, rate, age and standard deviations, from its state."""

from __future__ import annotations

import time

import numpy as np

from omnibench.live.estimation.health import FusionHealth, Health, Status
from omnibench.live.estimation.robot_state import RobotState
from omnibench.robot.kinematics import Array

_RATE_WINDOW = 0.9  # s, over which samples are counted at least; below the period of the diagnostics, 1 s
_BEHIND = 0.1  # s that samples may wait; a node whose samples wait for longer cannot keep up; chosen
_SECOND = 1e9  # ns


class HealthReporter:
    """Reports one robot's health. stale_after: s without wheel samples after which the stream counts as stale."""

    def __init__(self, stale_after: float) -> None:
        self._stale_after = stale_after
        self._counted = (time.monotonic(), 0)  # when samples were counted last, and how many there were
        self._rate = 0.0  # Hz
        self._behind = 0.0  # s, in the last whole window

    def report(self, state: RobotState, now: float, waiting_since: float | None = None) -> Health:
        """The health at ``now`` (s, monotonic). waiting_since: when the oldest message that waits came."""
        # Rate and waiting time of samples, measured once a window.
        since, counted = self._counted
        if now - since >= _RATE_WINDOW:
            self._rate = (state.counts.samples - counted) / (now - since)
            self._counted = now, state.counts.samples
            self._behind, state.behind = state.behind, 0.0
        if waiting_since is not None:
            state.behind = max(state.behind, now - waiting_since)
        age = None if state.arrival is None else now - state.arrival
        status, message = self._status(state, now, age)
        covariance = _covariance(state, age if status == "stale" else None)
        provenance = state.calibration.provenance
        return Health(
            robot=state.name,
            status=status,
            message=message,
            calibration=state.calibration.name,
            simulated=provenance is not None and provenance.simulated,
            rate_hz=self._rate,
            age_s=age,
            behind_s=self._longest_wait(state),
            last_stamp=state.timeline.newest / _SECOND if state.timeline.entries else None,
            position_sigma_m=float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2)),
            heading_sigma_rad=float(np.sqrt(covariance[2, 2])),
            fusion=_fusion_health(state, now),
            counts=state.counts.as_dict(),
            last_refusal=state.last_refusal,
            last_swap=state.last_swap,
            unfitted_motion_s=state.monitor.seconds,
        )

    def _longest_wait(self, state: RobotState) -> float:
        return max(self._behind, state.behind)

    def _status(self, state: RobotState, now: float, age: float | None) -> tuple[Status, str]:
        """The status and its reason in words. age: of the last wheel sample, s; None before the first."""
        if age is None:
            return "waiting", f"no wheel sample yet{f': {state.last_refusal}' if state.last_refusal else ''}"
        behind = self._longest_wait(state)
        if age > self._stale_after + behind:
            wheels = state.wheel_input
            if wheels.repeats and now - wheels.repeated_at <= self._stale_after + behind:
                repeated = f"{wheels.repeats} wheel samples have the stamp {state.timeline.newest / _SECOND:.3f} s"
                return "stale", f"stamps stand still: {repeated}; `wheels: {{stamps: arrival}}` takes times of arrival"
            return "stale", f"no wheel sample for {age:.1f} s"
        if behind > _BEHIND:
            return "degraded", f"behind by {behind:.1f} s: samples come faster than they can be taken"
        if old := state.wheel_input.old_steering:
            return "degraded", f"no steering angles for {old:.1f} s: the last ones are held"
        fusion = state.fusion
        if fusion is None:
            return "ok", "odometry"
        if not fusion.located:
            return "degraded", "no pose of SLAM yet"
        silent = None if fusion.fused_at is None else now - fusion.fused_at
        if silent is None or silent > fusion.settings.stale_after:
            rejected = f", {fusion.rejected_in_a_row} rejected" if fusion.rejected_in_a_row else ""
            return "degraded", "no pose of SLAM" + ("" if silent is None else f" fused for {silent:.1f} s") + rejected
        return "ok", "odometry and SLAM"


def _covariance(state: RobotState, silence: float | None) -> Array:
    """Covariance (3, 3) of the fused pose, or of odometry's; it grows in a silence of the wheels (s)."""
    odometry, fusion = state.odometry, state.fusion
    if fusion is None:
        return odometry.covariance if silence is None else odometry.covariance_after_silence(silence)
    if silence is None:
        return fusion.covariance
    return fusion.covariance + (odometry.covariance_after_silence(silence) - odometry.covariance)


def _fusion_health(state: RobotState, now: float) -> FusionHealth | None:
    fusion = state.fusion
    if fusion is None:
        return None
    return FusionHealth(
        located=fusion.located,
        pose_age_s=None if fusion.fused_at is None else now - fusion.fused_at,
        last_outcome=fusion.outcome,
        rejected_in_a_row=fusion.rejected_in_a_row,
    )
