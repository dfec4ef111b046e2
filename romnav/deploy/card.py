"""What a robot has to know of a policy beside its network: it travels in the file's metadata."""

from __future__ import annotations

from romnav.config import Config
from romnav.navigation.spec import CommandSpec
from romnav.sensing.spec import DepthSpec, LidarSpec

FORMAT = "romnav-onnx-1"
KEY = "romnav"
"""Entry of the metadata that holds the card as JSON."""
INPUTS = {
    "lidar": "(1, rows, columns) float32 range image, m: levelled, heading ahead, from the top left; 0 is no return",
    "depth": "(1, rows, columns) float32 depth along the optical axis, m; 0 is no return",
    "state": "(1, 9 + P) float32 in the robot's yaw frame: goal dx, dy (m), log|d| / log d_max, dz (m), sine and "
    "cosine of the heading to arrive with; the previous command (m/s, m/s, rad/s) before any filter; proprioception",
    "memory": "(2, 1, H) float32: zeros at first, then what came out",
}
OUTPUTS = {
    "command": "(1, 3) float32 forward, left (m/s), turn (rad/s) in the robot's yaw frame, to be held for one period",
    "next_memory": "(2, 1, H) float32",
}


class Measured(Config):
    """How well the policy did where it was evaluated."""

    episode_set: str
    """Name of the set of episodes."""
    digest: str
    """Of its initial conditions."""
    metrics: dict[str, float | None]
    """Metrics by name, over all episodes; those that are not defined are None."""


class Card(Config):
    """What a robot has to know of a policy."""

    format: str = FORMAT
    """Version of this card."""
    arm: str
    """Arm, training seed and scale that it is of."""
    seed: int
    scale: str
    steps: int
    """Steps of its training."""
    checkpoint: str
    """SHA-256 of the checkpoint that it was exported from."""
    commit: str
    """Commit of the code that exported it."""
    period: float
    """A command is held for so long, s."""
    command: CommandSpec
    """Limits of the command."""
    stair_limits: tuple[float, float] | None = None
    """Fastest forward command, m/s, and turn, rad/s, on stairs: the robot's locomotion has to keep them."""
    max_goal_distance: float
    """d_max of the goal observation, m."""
    lidar: LidarSpec
    """Image that it sees."""
    depth: DepthSpec | None
    """Depth image that it sees, if any."""
    proprioception: int
    """Numbers of proprioception, 0 for a policy of the reduced-order model."""
    memory: tuple[int, int, int]
    """Shape of the memory."""
    inputs: dict[str, str]
    """What goes in: shapes, units and frames. Images and state are normalised within the network."""
    outputs: dict[str, str] = OUTPUTS
    """What comes out."""
    error: float | None = None
    """Largest difference from PyTorch over the steps of the check, m/s or rad/s."""
    measured: Measured | None = None
    """None if it has not been evaluated."""
