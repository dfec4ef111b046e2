"""Configuration of the robot: its body, and the humanoid's model, engine and locomotion."""

from __future__ import annotations

from pydantic import Field

from romnav.config import Config
from romnav.world.spec import WorldSpec


class BodySpec(Config):
    """The upright cylinder that holds a walking G1, for collisions with the exact solids."""

    radius: float = 0.26
    """Radius about the pelvis, m (A: the smallest around the model's meshes with its arms hanging is 0.260)."""
    height: float = 1.33
    """Height, m (A: the meshes reach 1.324 with straight legs)."""
    step: float = 0.05
    """What is no higher above the ground is stepped over, m (A: as in the occupancy grids)."""


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
    kd_ratio: float = 0.07
    """Velocity gain over position gain, s (A)."""
    weld_arms: bool = True
    """Fix the 14 arm joints at `elbow` (A: 15 instead of 29 joints halve the cost; navigation never uses the arms)."""
    elbow: float = 1.2
    """Elbow angle of the fixed arms, rad (A)."""


class GaitSpec(Config):
    """The linear-inverted-pendulum reference (A throughout: the paper's cited work gives no numbers here)."""

    step_ticks: int = 20
    """Control steps of one step: 0.4 s."""
    pendulum: float = 0.66
    """Height of the centre of mass above the ground that sets the pendulum's frequency, m."""
    pelvis: float = 0.73
    """Height of the pelvis above the mean of both feet's ground, m: bent knees."""
    sink: float = 0.25
    """How much the pelvis sinks for each metre of height between the feet, -: keeps both in reach on stairs."""
    width: float = 0.20
    """Distance between the feet, m."""
    clearance: float = 0.09
    """Apex of the swing foot above the highest ground under its path, m."""
    swing_end: float = 1.0
    """Part of the step after which the swing foot is to stand."""
    swing_across: float = 0.95
    """Part of the swing after which the foot is over its foothold, -: the leg trails its target by about 60 ms."""
    reach_forward: tuple[float, float] = (-0.40, 0.50)
    """Limits of a foothold ahead of the stance foot, m."""
    reach_side: tuple[float, float] = (0.14, 0.42)
    """Limits of a foothold beside the stance foot, m."""
    edge_search: float = 0.14
    """How far a foothold may be moved along the heading to keep the sole off a stair's edge, m."""
    edge_margin: float = 0.045
    """Wanted distance of the sole from a riser before or behind it, m."""
    acceleration: tuple[float, float, float] = (0.8, 0.8, 1.5)
    """Fastest change of the command that the reference follows, m/s^2, m/s^2, rad/s^2."""
    integral_gain: float = 1.0
    """Of the velocity error into the orbit's velocity, 1/s."""
    integral_limit: float = 0.5
    """Largest correction of the orbit's velocity, m/s."""
    level: float = 0.05
    """Ground is level while neither the feet nor the next foothold are further above each other, m: the velocity's
    error is integrated there."""
    integral_decay: float = 0.5
    """Time in which the integral decays elsewhere, s."""
    stair_speed: float = 0.1
    """Added to a forward velocity that is larger, where the ground is not level, m/s."""
    pull: float = 0.6
    """Shift of the wanted pelvis per metre of error in the divergent component, -: the stance foot's part."""
    early: float = 0.05
    """Time taken off the prediction of the divergent component, s: the real body diverges more slowly."""
    climb: float = 0.20
    """Highest climb or drop from one foothold to the next, m: one riser."""
    upright_gain: float = 2.5
    """Extra stance correction per radian of pelvis tilt, -."""


class ClfSpec(Config):
    """Control-Lyapunov reward on the tracking error (CLF-RL; form P, numbers A)."""

    rate_time: float = 0.1
    """Time that makes a rate error comparable to a position error in Q = diag(1, rate_time^2), s."""
    effort: float = 1e-4
    """Weight R of the acceleration in the Riccati equation, s^4."""
    sigma: float = 1.5
    """Scale of V, mean over outputs in squared tolerances, -."""
    com: float = 0.08
    """Tolerance of the centre of mass from its orbit, m."""
    height: float = 0.04
    """Tolerance of the pelvis height, m."""
    tilt: float = 0.12
    """Tolerance of roll, pitch and yaw of the pelvis, rad."""
    swing: float = 0.05
    """Tolerance of the swing sole, m."""
    foot: float = 0.2
    """Tolerance of the swing sole's roll and pitch, rad."""


class RewardSpec(Config):
    """Weights of the reward terms, each per control step (A; terms of CLF-RL and its regularisers)."""

    scale: float = 0.2
    """Of the sum: a good step earns about 0.5."""
    clf: float = 1.0
    """exp(-V / sigma) + 1 / (2 (1 + V))."""
    decrease: float = 0.2
    """Penalty clip((dV/dt + lambda V) / sigma, 0, 1)."""
    velocity: float = 2.0
    """exp(-(e / 0.2)^2) of the velocity averaged over about a step, gated by the yaw-rate term."""
    velocity_linear: float = 0.6
    """Penalty on |e| itself: a gradient where the exponential is flat (stepping in place is a local optimum)."""
    yaw: float = 0.6
    """exp(-(e / 0.4)^2) of the averaged yaw rate."""
    upright: float = 1.5
    """Penalty on the horizontal part of gravity, squared."""
    action: float = 0.01
    """Penalty on the sum of squared actions."""
    action_rate: float = 0.01
    """Penalty on the sum of squared action differences."""
    torque: float = 4e-6
    """Penalty on the sum of squared torques, (N m)^-2."""
    collision: float = 0.3
    """Penalty on each body but the feet in contact."""
    alive: float = 0.5
    """For not having fallen."""
    fall: float = 2.0
    """Penalty once, not scaled, for a fall."""
    floor: float = -0.5
    """Lower bound of a step's reward, so that ending the episode never pays."""


class TaskSpec(Config):
    """The locomotion task."""

    robots: int = 256
    """Robots in parallel."""
    episode: float = 20.0
    """Longest episode, s."""
    action_scale: float = 0.3
    """Residual joint angle of one unit of action, rad."""
    shares: dict[str, float] = Field(default={"flat": 0.18, "rough": 0.04, "ramp": 0.06, "stairs": 0.52, "uturn": 0.20})
    """Share of the robots on each kind of terrain."""
    explore: float = 0.3
    """Share of the episodes on any level instead of the robot's own: steep stairs are tried before they are due."""
    forward: tuple[float, float] = (-0.5, 1.0)
    """Commanded forward velocity on the flat, m/s (forward limit P)."""
    lateral: float = 0.25
    """Commanded lateral velocity, m/s (P)."""
    turn: float = 1.0
    """Commanded yaw rate, rad/s (P)."""
    lane_speed: tuple[float, float] = (0.35, 0.9)
    """Commanded speed along lanes, m/s."""
    resample: float = 5.0
    """Time between new commands on the flat, s."""
    push: float = 0.4
    """Largest push, m/s, on the pelvis."""
    push_interval: float = 5.0
    """Mean time between pushes, s."""
    friction: tuple[float, float] = (0.5, 1.1)
    """Range of foot friction."""
    payload: tuple[float, float] = (-1.0, 2.0)
    """Range of mass added to the torso, kg."""


class TileTaskSpec(Config):
    """Locomotion as navigation asks for it: robots among the walls and stairs of tiles, commanded at 5 Hz (A)."""

    robots: int = 0
    """Robots on tiles, besides those on lanes."""
    begin: int = 0
    """Iterations before they join: until then the run is one without them."""
    world: WorldSpec = WorldSpec(tiles=48, side=20.0, goals_per_tile=32, classes=("building", "outdoor", "building"))
    """The tiles, small: walking needs no long ways, and classes without stairs teach little that lanes do not."""
    drivers: dict[str, float] = Field(default={"steps": 0.15, "smooth": 0.15, "oracle": 0.7})
    """Share of the episodes under commands that are drawn over the whole limits and held, under such that wander
    through them, and under the shortest path to a goal."""
    period: float = 0.2
    """Time for which a command is held, s (P: navigation's)."""
    hold: tuple[float, float] = (0.2, 3.0)
    """Time for which a drawn command is held, s."""
    speed: tuple[float, float] = (0.4, 1.0)
    """Speed along the shortest path, m/s; one for an episode."""
    fast: float = 0.5
    """Share of the episodes along shortest paths at the full speed."""
    stray: float = 0.4
    """Largest angle off the shortest path, rad, as it wanders."""
    burst: float = 0.03
    """Chance at each command of the shortest path that a drawn one takes over for a while."""
    mouth: float = 0.5
    """Share of the starts beside the end of a stair or ramp."""
    wall: float = 0.25
    """Share of the starts beside an obstacle or an edge."""
    cross: float = 0.75
    """Share of the goals on another level than the start, where there are any."""


class PpoSpec(Config):
    """PPO by rsl-rl."""

    steps: int = 24
    """Control steps per iteration."""
    epochs: int = 4
    """Passes over the batch."""
    minibatches: int = 4
    """Per pass."""
    hidden: tuple[int, ...] = (256, 128, 64)
    """Widths of the policy and of the critic."""
    learning_rate: tuple[float, float] = (5e-5, 1.5e-3)
    """Range of the adaptive rate; it starts at the floor."""
    desired_kl: float = 0.02
    """Of a whole iteration."""
    entropy: float = 0.0
    """Weight of the entropy (0.003 drives the noise up for ever, and noise costs stairs)."""
    std: tuple[float, float, float] = (0.2, 0.25, 1.0)
    """Floor, start and ceiling of the action noise, in units of action."""
    average: float = 0.99
    """Of the weights over iterations: the policy that is used is the mean of about the last hundred, which stays up on
    stairs where the single ones come and go."""
    gamma: float = 0.99
    """Discount."""
    lam: float = 0.95
    """Of generalised advantages."""


class LocomotionSpec(Config):
    """Everything that decides a locomotion policy."""

    robot: RobotSpec = RobotSpec()
    gait: GaitSpec = GaitSpec()
    clf: ClfSpec = ClfSpec()
    reward: RewardSpec = RewardSpec()
    task: TaskSpec = TaskSpec()
    tiles: TileTaskSpec = TileTaskSpec()
    ppo: PpoSpec = PpoSpec()
    iterations: int = 4000
    """PPO iterations."""
    seed: int = Field(default=1, ge=0)
    """Of everything random."""

    def steps(self, iteration: int) -> int:
        """Policy steps until the end of an iteration."""
        joined = max(iteration - self.tiles.begin, 0)
        return self.ppo.steps * (iteration * self.task.robots + joined * self.tiles.robots)
