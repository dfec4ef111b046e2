"""Configuration of the humanoid: model, engine and locomotion."""

from __future__ import annotations

from romnav.config import Config


class RobotSpec(Config):
    """The Unitree G1 in MuJoCo (MuJoCo Menagerie's model: measured armature, torque limits, primitive collision)."""

    timestep: float = 0.01
    """Physics step, s (A: half the cost of 5 ms; `implicitfast` keeps the PD loop stable)."""
    decimation: int = 2
    """Physics steps per control step: 50 Hz (P)."""
    friction: float = 0.8
    """Sliding friction between foot and ground, - (A)."""
    kp_leg: float = 100.0
    """Hip position gain, N m/rad (A)."""
    kp_knee: float = 150.0
    """Knee and waist position gain, N m/rad (A: the knee carries the weight on stairs)."""
    kp_ankle: float = 40.0
    """Ankle position gain, N m/rad (A)."""
    kd_ratio: float = 0.03
    """Velocity gain over position gain, s (A)."""
    weld_arms: bool = True
    """Fix the 14 arm joints at `elbow` (A: 15 instead of 29 joints halve the cost; navigation never uses the arms)."""
    elbow: float = 1.2
    """Elbow angle of the fixed arms, rad (A)."""
