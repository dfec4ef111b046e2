"""Configuration of the navigation task, policy and learning."""

from __future__ import annotations

from operator import attrgetter
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from romnav.config import (
    LARGEST,
    Config,
    Count,
    NonNegative,
    NonPositive,
    Number,
    Positive,
    Range,
    Rate,
    Share,
    Threads,
    Width,
)
from romnav.errors import RomnavError
from romnav.parts import Kind
from romnav.sensing.spec import CorruptionSpec
from romnav.world.spec import SamplerSpec

REWARDS = Kind("reward term", "romnav.rewards", "romnav.navigation.rewards:Term")
NETWORKS = Kind("policy network", "romnav.networks", "romnav.navigation.policy:NavigationActor", called=False)
BODIES = Kind("body", "romnav.bodies", "romnav.robot.dynamics:Dynamics", builtin=("rom", "g1"), called=False)
MOST_STEPS = 1_000_000
"""Of an episode."""
WIDEST_HEAD = 64
"""Channels of an attention head that a kernel keeps in registers."""


class CommandSpec(Config):
    """Velocity limits of the command (paper, Sec. III-D)."""

    forward: Positive = 1.0
    """Fastest forward, m/s (P)."""
    reverse: NonNegative = 0.5
    """Fastest backward, m/s (A: the paper names no reverse limit)."""
    lateral: NonNegative = 0.25
    """Fastest sideways, m/s (P)."""
    turn: NonNegative = 1.0
    """Fastest turn, rad/s (P)."""


class RewardSpec(Config):
    """Reward terms and weights (paper, Table I)."""

    position: NonNegative = 0.2
    """Weight of the planar position term (P)."""
    heading: NonNegative = 0.2
    """Weight of the heading term (P)."""
    height: NonNegative = 0.2
    """Weight of the height term (P)."""
    stand: NonNegative = 0.2
    """Weight of standing still (P)."""
    geodesic_progress: NonNegative = 0.1
    """Weight of progress along the geodesic (P)."""
    height_progress: NonNegative = 0.1
    """Weight of progress in height (P)."""
    collision: NonPositive = -1.0
    """Weight per body in contact (P)."""
    collision_late: NonPositive | None = Field(default=None, exclude_if=lambda weight: weight is None)
    """The same from where the action rate's weight switches (A: as before; a policy that has to be free to explore
    first can be made careful then)."""
    action_rate: tuple[NonPositive, NonPositive] = (-0.01, -0.1)
    """Weight of the squared change of the command before and after the switch (P)."""
    action_rate_switch: Share = 0.5
    """Share of the run after which the action-rate weight switches (P: iteration 1000 of 2000), and the collision's if
    it does."""
    gate: NonNegative = 2.0
    """Geodesic distance below which the gated terms pay, m (P)."""
    progress_speed: Positive = 0.75
    """Planar speed that earns the full geodesic progress, m/s (A: a brisk walk leaves room below the limit)."""
    climb_speed: Positive = 0.25
    """Vertical speed that earns the full height progress, m/s (A: a flight of stairs at half of the top speed)."""
    scale: Positive = 0.2
    """Common factor, s (A: the control period, so that returns are integrals over time)."""
    terms: dict[Annotated[str, REWARDS], Number] = Field(default={}, exclude_if=lambda terms: not terms)
    """Weights of terms from outside, by "pkg.mod:Name"."""


class EnvSpec(Config):
    """Episodes of the navigation task."""

    envs: int = Field(default=512, ge=1, le=2**20)
    """Parallel environments (P: 4096)."""
    period: Positive = 0.2
    """Control period, s (P: 5 Hz)."""
    duration: Positive = 45.0
    """Longest episode, s (P)."""
    stay: NonNegative = 45.0
    """An episode is truncated, not ended, this long after the goal was first reached, s (A: never, as the paper
    rewards standing on the goal; short runs use a few seconds and spend the steps on new goals)."""
    patience: Positive = 45.0
    """An episode is truncated, not ended, after this long without coming nearer to the goal than ever before, s (A:
    never, as the paper names no such end; progress is measured along the shortest path, so short runs lose little by
    starting over)."""
    reach: Positive = 0.5
    """Distance that counts as arrival, m (P, of evaluation; A: in 3D, or goals would be reached from other floors)."""
    max_goal_distance: float = Field(default=30.0, gt=1.0, le=LARGEST)
    """d_max of the goal observation, m, whose logarithm divides (A: the geodesic cap, beyond which no goal of training
    lies)."""
    command: CommandSpec = CommandSpec()
    reward: RewardSpec = RewardSpec()
    sampler: SamplerSpec = SamplerSpec()

    @model_validator(mode="after")
    def _has_steps(self) -> Self:
        if not 1.0 <= self.duration / self.period <= MOST_STEPS:
            raise ValueError(
                f"duration: {self.duration} s in steps of {self.period} s (period); make it 1 to {MOST_STEPS:,} steps"
            )
        return self


class PolicySpec(Config):
    """Network (paper, Sec. III-B)."""

    attention: Width = 64
    """Width of self- and cross-attention (A)."""
    heads: Width = 4
    """Attention heads (A)."""
    queries: Width = 4
    """Learned queries of the cross-attention; one more comes from the non-visual observation (P)."""
    recurrent: Width = 128
    """Width of the two-layer GRU (A)."""
    hidden: Width = 128
    """Width of the dense layer before the Beta parameters (A)."""
    support: float = Field(default=1.0, ge=1.0, le=2.0, exclude_if=lambda support: support == 1.0)
    """Breadth of what the Betas draw from over the limits of the command, beyond which actions are cut (A: 1; but the
    mean of a Beta stays short of the ends of its support, and a policy that acts by means short of its fastest)."""
    critic: tuple[Width, ...] = Field(default=(128, 128), min_length=1)
    """Hidden widths of the privileged critic (A)."""
    network: Annotated[str, NETWORKS] | None = Field(default=None, exclude_if=lambda network: network is None)
    """Policy network from outside, "pkg.mod:Name"."""

    @property
    def visual(self) -> int:
        """Number of features that the network makes of the tokens."""
        return (self.queries + 1) * self.attention

    @model_validator(mode="after")
    def _has_equal_heads(self) -> Self:
        if self.attention % self.heads:
            raise ValueError(
                f"attention: {self.attention} channels for {self.heads} heads (heads); use a multiple of them"
            )
        if self.attention > WIDEST_HEAD * self.heads:
            raise ValueError(f"heads: {self.heads} for {self.attention} channels; {WIDEST_HEAD} each are the most")
        return self


class EncoderUseSpec(Config):
    """What becomes of the LiDAR encoder in reinforcement learning (paper, Sec. IV-B, "Pretrained Encoders")."""

    pretrained: bool = True
    """Whether it starts from the pretrained weights (P) or, as the paper's No Pretraining, from random ones."""
    unfreeze_at: Share = 1.0
    """Share of the run after which PPO trains it as well; 1 is never (P: the paper's ablation has 1000 of 2000
    iterations)."""


class PPOSpec(Config):
    """PPO (Schulman et al., 2017) as rsl-rl implements it."""

    stages: Count = 1
    """Times `iterations` that a run takes. Single-Stage takes as many as both stages of RoM-Nav together (P: 4000);
    what is a share of `iterations`, the switch of the action rate, stays where it is."""
    iterations: Count = 2000
    """Iterations of one rollout and one update each (P)."""
    steps: Count = 36
    """Steps per environment and iteration (A)."""
    epochs: Count = 5
    """Passes over each rollout (A)."""
    minibatches: Count = 8
    """Minibatches per pass (P)."""
    gamma: Share = 0.997
    """Discount per step (A)."""
    lam: Share = 0.95
    """Generalised advantage estimation (A)."""
    clip: Positive = 0.2
    """Surrogate clip (A)."""
    entropy: NonNegative = 0.003
    """Entropy coefficient (A)."""
    value: NonNegative = 1.0
    """Value-loss coefficient (A)."""
    guidance: NonNegative = 0.0
    """Coefficient of the loss of guessing where the shortest path leads, and how long it is, from what the policy has
    seen (P: none; A: trains the memory on every step, where reward is rare)."""
    learning_rate: Rate = 1e-3
    """Initial learning rate (A)."""
    learning_rate_range: Range[Rate] = (1e-4, 1e-2)
    """Bounds of the adaptive learning rate (A: small batches measure the KL noisily and would drive it to nothing)."""
    desired_kl: Positive = 0.01
    """Target of the adaptive learning rate (A)."""
    max_grad_norm: Positive = 1.0
    """Gradient clip (A)."""
    keep: Count | None = None
    """Iterations after which the policy so far is kept beside the run, again and again (A: its success on the `dev`
    episodes shows progress where success while training depends on where the robots are let go)."""
    average: Share = Field(default=0.0, exclude_if=lambda share: share == 0.0)
    """Share of the updates so far, the last ones, over which the weights of the saved policy are averaged (P: 0, the
    last weights alone; A: the noise of the last updates costs success)."""
    threads: Threads = 1
    """PyTorch threads of the run (A: another number gives other bits; two runs on a thread each do half as much again
    as one run on two)."""


class Schedule(Config):
    """A number that changes linearly once over a run."""

    start: NonNegative
    """Before."""
    end: NonNegative
    """After."""
    between: tuple[float, float] = (0.0, 1.0)
    """Shares of the run at which the change begins and is done."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not 0.0 <= self.between[0] < self.between[1] <= 1.0:
            raise ValueError(f"between: {list(self.between)}; set two rising shares from 0 to 1")
        return self

    def __call__(self, share: float) -> float:
        """Value once ``share`` of the run is done."""
        low, high = self.between
        return self.start + (self.end - self.start) * min(max((share - low) / (high - low), 0.0), 1.0)


class KickstartSpec(Config):
    """Training held to a teacher: L_PPO + lambda L_KL (paper, Sec. III-C)."""

    teacher: str
    """Arm whose policy is the teacher (P: the reduced-order model's)."""
    direction: Literal["teacher-student", "student-teacher"] = "teacher-student"
    """KL(teacher || student), or the other way round (A: the literature's; the paper writes KL(pi, pi_R), not saying
    which it means)."""
    weight: Schedule = Schedule(start=1.0, end=0.05, between=(0.05, 0.55))
    """lambda (P: 1 until iteration 100 of 2000, 0.05 from 1100 on; A: linearly)."""
    ppo: Schedule = Schedule(start=1.0, end=1.0)
    """Factor of PPO's surrogate and entropy, not of the value loss; 0 is distillation alone (P: 1 throughout)."""
    init: Literal["fresh", "teacher"] = "fresh"
    """Weights that the student begins with: random ones, or the teacher's, with what it sees in addition not connected
    yet (A: the paper names no warm start)."""
    critic_first: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Share of the run in which only the critic learns (A: none; a critic that knows nothing spoils a policy that was
    given something)."""
    concentration: float | None = Field(default=None, gt=2.0, le=1e6)
    """Upper bound on the sum of the teacher's two Beta parameters (A: none; a certain teacher leaves the student no
    exploration)."""


class NavigationSpec(Config):
    """Everything that the navigation stage needs beside world, sensors and encoder."""

    dynamics: Annotated[str, BODIES] = "rom"
    """The body that is driven: the reduced-order model, "g1", the humanoid under its frozen locomotion policy, or one
    from outside, "pkg.mod:Name"."""
    stair_limits: tuple[Positive, Positive] | None = Field(default=None, exclude_if=lambda limits: limits is None)
    """Fastest forward command, m/s, and turn, rad/s, that the humanoid follows while its next foothold is not level
    with its feet (A: none, as in the paper)."""
    tiles: int | None = Field(default=None, ge=1, le=2**16, exclude_if=lambda tiles: tiles is None)
    """Number of tiles to train on where it is not ``world.tiles``, on which encoders are trained, too; of the same seed
    (A: none; a long run learns few tiles by heart)."""
    corruption: CorruptionSpec = CorruptionSpec(dropout=(0.0, 0.1))
    """What is done to the range images that the policy sees (A: a running sensor loses far fewer pixels than
    pretraining drops)."""
    encoder: EncoderUseSpec = EncoderUseSpec()
    env: EnvSpec = EnvSpec()
    policy: PolicySpec = PolicySpec()
    ppo: PPOSpec = PPOSpec()

    @model_validator(mode="after")
    def _has_minibatches(self) -> Self:
        if self.stair_limits is not None and self.dynamics != "g1":
            raise ValueError(
                f"stair_limits: {self.dynamics} has no feet to be slow with; set dynamics to g1, or leave it"
            )
        if self.ppo.minibatches > self.env.envs:
            raise ValueError(
                f"ppo.minibatches: {self.ppo.minibatches} of {self.env.envs} environments (env.envs); lower it"
            )
        if self.env.envs * self.ppo.steps < 2:
            raise ValueError("ppo.steps: one step of one environment has no deviation to normalise by; raise it")
        return self


_TASK = (
    "policy.support",
    *(f"env.command.{limit}" for limit in CommandSpec.model_fields),
    "env.max_goal_distance",
    "env.period",
)
"""Settings that say what the numbers mean that a policy is given and gives."""


def require_same_task(teacher: NavigationSpec, student: NavigationSpec, where: str) -> None:
    """Checks that a teacher's actions mean what its student's do, and that both are told of the goal alike.

    Args:
        teacher: What it is trained with.
        student: The same of the student.
        where: What the error begins with: the file or the key that names the teacher.

    Raises:
        RomnavError: A setting differs that the divergence takes for the same.
    """
    for key in _TASK:
        theirs, own = (attrgetter(key)(spec) for spec in (teacher, student))
        if theirs != own:
            raise RomnavError(
                f"{where}: a teacher with navigation.{key} = {theirs:g}, and its student has {own:g}; "
                "give both the same"
            )
