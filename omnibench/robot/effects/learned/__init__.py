"""Effects that a network computes: kinematics learned from recordings."""

from omnibench.robot.effects.learned import network_effect

__all__ = ["network_effect"]
