"""Configuration of the robot: its body, and the humanoid's model, engine and locomotion."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from romnav.config import (
    Config,
    Count,
    NonNegative,
    NonPositive,
    Number,
    Positive,
    Range,
    Rate,
    Seed,
    Share,
    Width,
)
from romnav.world.spec import WorldSpec

Robots = Annotated[int, Field(ge=0, le=2**16)]
"""Robots in parallel."""

TERRAINS = ("flat", "rough", "ramp", "stairs", "uturn")
"""Kinds of lanes."""
DRIVERS = ("steps", "smooth", "oracle")
"""Who commands robots on tiles."""


class BodySpec(Config):
    """The upright cylinder that holds a walking G1, for collisions with the exact solids."""

    radius: Positive = 0.26
    """Radius about the pelvis, m (A: the smallest around the model's meshes with its arms hanging is 0.260)."""
    height: Positive = 1.33
    """Height, m (A: the meshes reach 1.324 with straight legs)."""
    step: NonNegative = 0.05
    """What is no higher above the ground is stepped over, m (A: as in the occupancy grids)."""


class RobotSpec(Config):
    """The Unitree G1 in MuJoCo (MuJoCo Menagerie's model: measured armature, torque limits, primitive collision)."""

    timestep: float = Field(default=0.01, gt=0.0, le=0.02)
    """Physics step, s (A: half the cost of 5 ms; `implicitfast` keeps the PD loop stable)."""
    decimation: Count = 2
    """Physics steps per control step: 50 Hz (P)."""
    friction: NonNegative = 0.8
    """Sliding friction between foot and ground, - (A)."""
    kp_leg: Positive = 100.0
    """Hip position gain, N m/rad (A)."""
    kp_knee: Positive = 150.0
    """Knee and waist position gain, N m/rad (A: the knee carries the weight on stairs)."""
    kp_ankle: Positive = 40.0
    """Ankle position gain, N m/rad (A)."""
    kd_ratio: NonNegative = 0.07
    """Velocity gain over position gain, s (A)."""
    weld_arms: bool = True
    """Fix the 14 arm joints at `elbow` (A: 15 instead of 29 joints halve the cost; navigation never uses the arms).
    False is for a model alone (`g1.build_spec`), to hold the fixed arms against: no robot here drives 29 joints."""
    elbow: float = Field(default=1.2, ge=-math.pi, le=math.pi)
    """Elbow angle of the fixed arms, rad (A)."""

    def ticks(self, period: float) -> int:
        """Control steps in a ``period``, s; 0 where it is no multiple of them."""
        tick = self.timestep * self.decimation
        count = round(period / tick)
        return count if abs(count * tick - period) < 1e-9 else 0


class GaitSpec(Config):
    """The linear-inverted-pendulum reference (A throughout: the paper's cited work gives no numbers here)."""

    step_ticks: Count = 20
    """Control steps of one step: 0.4 s."""
    pendulum: Positive = 0.66
    """Height of the centre of mass above the ground that sets the pendulum's frequency, m."""
    pelvis: Positive = 0.73
    """Height of the pelvis above the mean of both feet's ground, m: bent knees."""
    sink: NonNegative = 0.25
    """How much the pelvis sinks for each metre of height between the feet, -: keeps both in reach on stairs."""
    width: NonNegative = 0.20
    """Distance between the feet, m."""
    clearance: NonNegative = 0.09
    """Apex of the swing foot above the highest ground under its path, m."""
    swing_end: Share = 1.0
    """Part of the step after which the swing foot is to stand."""
    swing_across: Share = 0.95
    """Part of the swing after which the foot is over its foothold, -: the leg trails its target by about 60 ms."""
    reach_forward: Range[Number] = (-0.40, 0.50)
    """Limits of a foothold ahead of the stance foot, m."""
    reach_side: Range[NonNegative] = (0.14, 0.42)
    """Limits of a foothold beside the stance foot, m."""
    edge_search: NonNegative = 0.14
    """How far a foothold may be moved along the heading to keep the sole off a stair's edge, m."""
    edge_margin: NonNegative = 0.045
    """Wanted distance of the sole from a riser before or behind it, m."""
    acceleration: tuple[Positive, Positive, Positive] = (0.8, 0.8, 1.5)
    """Fastest change of the command that the reference follows, m/s^2, m/s^2, rad/s^2."""
    ahead: Positive = 0.3
    """On level ground the gait is to go at most this much faster forward than the body goes, m/s."""
    integral_gain: NonNegative = 1.0
    """Of the velocity error into the orbit's velocity, 1/s."""
    integral_limit: NonNegative = 0.5
    """Largest correction of the orbit's velocity, m/s."""
    level: NonNegative = 0.05
    """Ground is level while neither the feet nor the next foothold are further above each other, m: the velocity's
    error is integrated there."""
    integral_decay: Positive = 0.5
    """Time in which the integral decays elsewhere, s."""
    stair_speed: NonNegative = 0.1
    """Added to a forward velocity that is larger, where the ground is not level, m/s."""
    pull: NonNegative = 0.6
    """Shift of the wanted pelvis per metre of error in the divergent component, -: the stance foot's part."""
    early: NonNegative = 0.05
    """Time taken off the prediction of the divergent component, s: the real body diverges more slowly."""
    climb: NonNegative = 0.20
    """Highest climb or drop from one foothold to the next, m: one riser."""
    upright_gain: NonNegative = 2.5
    """Extra stance correction per radian of pelvis tilt, -."""


class ClfSpec(Config):
    """Control-Lyapunov reward on the tracking error (CLF-RL; form P, numbers A)."""

    rate_time: Positive = 0.1
    """Time that makes a rate error comparable to a position error in Q = diag(1, rate_time^2), s."""
    effort: Positive = 1e-4
    """Weight R of the acceleration in the Riccati equation, s^4."""
    sigma: Positive = 1.5
    """Scale of V, mean over outputs in squared tolerances, -."""
    com: Positive = 0.08
    """Tolerance of the centre of mass from its orbit, m."""
    height: Positive = 0.04
    """Tolerance of the pelvis height, m."""
    tilt: Positive = 0.12
    """Tolerance of roll, pitch and yaw of the pelvis, rad."""
    swing: Positive = 0.05
    """Tolerance of the swing sole, m."""
    foot: Positive = 0.2
    """Tolerance of the swing sole's roll and pitch, rad."""


class RewardSpec(Config):
    """Weights of the reward terms, each per control step (A; terms of CLF-RL and its regularisers)."""

    scale: Positive = 0.2
    """Of the sum: a good step earns about 0.5."""
    clf: NonNegative = 1.0
    """exp(-V / sigma) + 1 / (2 (1 + V))."""
    decrease: NonNegative = 0.2
    """Penalty clip((dV/dt + lambda V) / sigma, 0, 1)."""
    velocity: NonNegative = 2.0
    """exp(-(e / 0.2)^2) of the velocity averaged over about a step, gated by the yaw-rate term."""
    velocity_linear: NonNegative = 0.6
    """Penalty on |e| itself: a gradient where the exponential is flat (stepping in place is a local optimum)."""
    yaw: NonNegative = 0.6
    """exp(-(e / 0.4)^2) of the averaged yaw rate."""
    upright: NonNegative = 1.5
    """Penalty on the horizontal part of gravity, squared."""
    torso: NonNegative = Field(default=0.0, exclude_if=lambda weight: weight == 0.0)
    """The same of the torso, which carries the sensors: where it leans forward they see little but the ground."""
    action: NonNegative = 0.01
    """Penalty on the sum of squared actions."""
    action_rate: NonNegative = 0.01
    """Penalty on the sum of squared action differences."""
    torque: NonNegative = 4e-6
    """Penalty on the sum of squared torques, (N m)^-2."""
    collision: NonNegative = 0.3
    """Penalty on each body but the feet in contact."""
    alive: NonNegative = 0.5
    """For not having fallen."""
    fall: NonNegative = 2.0
    """Penalty once, not scaled, for a fall."""
    floor: NonPositive = -0.5
    """Lower bound of a step's reward, so that ending the episode never pays."""


class TaskSpec(Config):
    """The locomotion task."""

    robots: Robots = Field(default=256, ge=1)
    """Robots in parallel."""
    episode: Positive = 20.0
    """Longest episode, s."""
    action_scale: Positive = 0.3
    """Residual joint angle of one unit of action, rad."""
    shares: dict[str, Share] = Field(default={"flat": 0.18, "rough": 0.04, "ramp": 0.06, "stairs": 0.52, "uturn": 0.20})
    """Share of the robots on each kind of terrain."""
    explore: Share = 0.3
    """Share of the episodes on any level instead of the robot's own: steep stairs are tried before they are due."""
    forward: Range[Number] = (-0.5, 1.0)
    """Commanded forward velocity on the flat, m/s (forward limit P)."""
    lateral: NonNegative = 0.25
    """Commanded lateral velocity, m/s (P)."""
    turn: NonNegative = 1.0
    """Commanded yaw rate, rad/s (P)."""
    lane_speed: Range[Positive] = (0.35, 0.9)
    """Commanded speed along lanes, m/s."""
    resample: Positive = 5.0
    """Time between new commands on the flat, s."""
    push: NonNegative = 0.4
    """Largest push, m/s, on the pelvis."""
    push_interval: Positive = 5.0
    """Mean time between pushes, s."""
    friction: Range[NonNegative] = (0.5, 1.1)
    """Range of foot friction."""
    payload: Range[Number] = (-1.0, 2.0)
    """Range of mass added to the torso, kg."""

    @field_validator("shares")
    @classmethod
    def _known(cls, shares: dict[str, float]) -> dict[str, float]:
        if not {"flat"} <= shares.keys() <= set(TERRAINS) or not sum(shares.values()):
            raise ValueError(f"{shares}; give shares to flat and to others of {', '.join(TERRAINS)}, not all of them 0")
        return shares


class TileTaskSpec(Config):
    """Locomotion as navigation asks for it: robots among the walls and stairs of tiles, commanded at 5 Hz (A)."""

    robots: Robots = 0
    """Robots on tiles, besides those on lanes."""
    begin: int = Field(default=0, ge=0, le=2**31 - 1)
    """Iterations before they join: until then the run is one without them."""
    world: WorldSpec = WorldSpec(tiles=48, side=20.0, goals_per_tile=32, classes=("building", "outdoor", "building"))
    """The tiles, small: walking needs no long ways, and classes without stairs teach little that lanes do not."""
    period: Positive = 0.2
    """Time for which a command is held, s (P: navigation's)."""
    drivers: dict[str, Share] = Field(default={"steps": 0.15, "smooth": 0.15, "oracle": 0.7})
    """Share of the episodes under commands that are drawn over the whole limits and held, under such that wander
    through them, and under the shortest path to a goal."""
    hold: Range[NonNegative] = (0.2, 3.0)
    """Time for which a drawn command is held, s."""
    speed: Range[Positive] = (0.4, 1.0)
    """Speed along the shortest path, m/s; one for an episode."""
    fast: Share = 0.5
    """Share of the episodes along shortest paths at the full speed."""
    stray: NonNegative = 0.4
    """Largest angle off the shortest path, rad, as it wanders."""
    burst: Share = 0.03
    """Chance at each command of the shortest path that a drawn one takes over for a while."""
    mouth: Share = 0.5
    """Share of the starts beside the end of a stair or ramp."""
    wall: Share = 0.25
    """Share of the starts beside an obstacle or an edge."""
    cross: Share = 0.75
    """Share of the goals on another level than the start, where there are any."""

    @field_validator("drivers")
    @classmethod
    def _known(cls, drivers: dict[str, float]) -> dict[str, float]:
        if drivers.keys() != set(DRIVERS) or not sum(drivers.values()):
            raise ValueError(f"{drivers}; give a share to each of {', '.join(DRIVERS)}, not all of them 0")
        return drivers


class PpoSpec(Config):
    """PPO by rsl-rl."""

    steps: Count = 24
    """Control steps per iteration."""
    epochs: Count = 4
    """Passes over the batch."""
    minibatches: Count = 4
    """Per pass."""
    hidden: tuple[Width, ...] = Field(default=(256, 128, 64), min_length=1)
    """Widths of the policy and of the critic."""
    learning_rate: Range[Rate] = (5e-5, 1.5e-3)
    """Range of the adaptive rate; it starts at the floor."""
    desired_kl: Positive = 0.02
    """Of a whole iteration."""
    entropy: NonNegative = 0.0
    """Weight of the entropy (0.003 drives the noise up for ever, and noise costs stairs)."""
    std: tuple[Positive, Positive, Positive] = (0.2, 0.25, 1.0)
    """Floor, start and ceiling of the action noise, in units of action."""
    average: float = Field(default=0.99, ge=0.0, lt=1.0)
    """Of the weights over iterations: the policy that is used is the mean of about the last hundred, which stays up on
    stairs where the single ones come and go."""
    gamma: Share = 0.99
    """Discount."""
    lam: Share = 0.95
    """Of generalised advantages."""

    @model_validator(mode="after")
    def _has_a_start(self) -> Self:
        low, start, high = self.std
        if not low <= start <= high:
            raise ValueError(f"std: {list(self.std)}; set a floor, a start above it and a ceiling above that")
        return self


class LocomotionSpec(Config):
    """Everything that decides a locomotion policy."""

    robot: RobotSpec = RobotSpec()
    gait: GaitSpec = GaitSpec()
    clf: ClfSpec = ClfSpec()
    reward: RewardSpec = RewardSpec()
    task: TaskSpec = TaskSpec()
    tiles: TileTaskSpec = TileTaskSpec()
    ppo: PpoSpec = PpoSpec()
    iterations: Count = 4000
    """PPO iterations."""
    seed: Seed = 1
    """Of everything random."""

    @model_validator(mode="after")
    def _can_walk(self) -> Self:
        if not self.robot.weld_arms:
            raise ValueError("robot.weld_arms: false, but only legs and waist are driven; leave it out")
        tick = self.robot.timestep * self.robot.decimation
        for name, time in (
            ("task.episode", self.task.episode),
            ("task.resample", self.task.resample),
            ("tiles.period", self.tiles.period),
        ):
            if round(time / tick) < 1:
                raise ValueError(f"{name}: {time} s, less than a control step of {tick} s; raise it")
        if self.ppo.minibatches > self.task.robots * self.ppo.steps:
            raise ValueError(f"ppo.minibatches: {self.ppo.minibatches}, more than robots times steps; lower it")
        return self

    def steps(self, iteration: int) -> int:
        """Policy steps until the end of an iteration."""
        joined = max(iteration - self.tiles.begin, 0)
        return self.ppo.steps * (iteration * self.task.robots + joined * self.tiles.robots)
