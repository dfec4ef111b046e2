"""Policies that leave: exported to ONNX, and run on a robot's sensors at the control rate."""

from romnav.deploy.replay import Stream, replay
from romnav.deploy.runner import Runner, Sensed, Velocity

__all__ = ["Runner", "Sensed", "Stream", "Velocity", "replay"]
