"""Kickstarting: PPO on the humanoid while held to a teacher from the reduced-order model (paper, Sec. III-C).

The loss is L_PPO + lambda L_KL (Schmitt et al., 2018). The teacher sees what the student sees, along the student's own
episodes, and never acts.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import HiddenState
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from romnav import ranks
from romnav.errors import RomnavError
from romnav.files import digest
from romnav.navigation import checkpoint
from romnav.navigation.observations import ACTIONS
from romnav.navigation.perception import Perception
from romnav.navigation.policy import NavigationActor
from romnav.navigation.ppo import BoundedPPO
from romnav.navigation.spec import KickstartSpec, NavigationSpec, require_same_task

PLACES = ("cross", "stairs")
"""Where divergences are reported apart: goals across levels; steps on a stair or ramp."""


def beta_divergence(p: Tensor, q: Tensor) -> Tensor:
    """KL(p || q), nat, of Beta distributions with parameters (..., 2, D), summed over the last dimension."""
    (a, b), (c, d) = p.unbind(-2), q.unbind(-2)
    log_beta = torch.lgamma(c) + torch.lgamma(d) - torch.lgamma(c + d)
    log_beta = log_beta - torch.lgamma(a) - torch.lgamma(b) + torch.lgamma(a + b)
    means = (a - c) * torch.digamma(a) + (b - d) * torch.digamma(b) + (c - a + d - b) * torch.digamma(a + b)
    return (log_beta + means).sum(-1)


def bounded(parameters: Tensor, concentration: float) -> Tensor:
    """Beta parameters (..., 2, D) above 1 that sum to at most ``concentration`` > 2; the modes stay where they are."""
    above = parameters - 1.0
    scale = ((concentration - 2.0) / above.sum(-2, keepdim=True)).clamp(max=1.0)
    return 1.0 + above * scale


def inherit(student: NavigationActor, teacher: NavigationActor) -> None:
    """Give the student the teacher's weights; what it sees in addition does nothing yet.

    Raises:
        RomnavError: The networks differ in more than what they see.
    """
    own, given = student.state_dict(), teacher.state_dict()
    for name, value in own.items():
        taken = given.get(name, value)
        if taken.shape[:-1] != value.shape[:-1] or taken.shape[-1] > value.shape[-1]:
            raise RomnavError(
                f"kickstart.init: the teacher's {name} is {tuple(taken.shape)}, the student's {tuple(value.shape)}; "
                "give both the same navigation.policy, or start from 'fresh'"
            )
        taken = taken.clone()
        value.zero_()
        value[..., : taken.shape[-1]] = taken


class Teacher:
    """A frozen policy that is asked what it would do, with a memory of its own."""

    def __init__(
        self, path: Path, perception: Perception, spec: KickstartSpec, student: NavigationSpec, device: str
    ) -> None:
        """Load the policy of ``path`` for a ``student``.

        Raises:
            RomnavError: As `checkpoint.load_actor` and `require_same_task`; it has an encoder of its own, and cannot
                read the student's tokens.
        """
        require_same_task(checkpoint.load_spec(path), student, str(path))
        depth = perception.depth.encoder if perception.depth else None
        with torch.random.fork_rng():  # the weights that a network is made with are drawn, and the run's draws go on
            self.actor = checkpoint.load_actor(path, perception.encoder, device, depth_encoder=depth)
        if self.actor.encoder is not None:
            raise RomnavError(f"{path}: a teacher that trained its encoder; kickstart from one with a frozen encoder")
        self.actor.requires_grad_(False)
        self.spec = spec
        self.digest = digest(path)

    def __call__(self, obs: TensorDict) -> Tensor:
        """(E, 2, `ACTIONS`) float32 Beta parameters, one step on in its memory."""
        parameters = self.actor.beta(obs).float()
        return parameters if self.spec.concentration is None else bounded(parameters, self.spec.concentration)


class KickstartedPPO(BoundedPPO):
    """PPO with the divergence from a teacher as a further term of the loss."""

    teacher: Teacher
    places: Callable[[], Tensor]
    entropy_coef: float

    def enrol(self, teacher: Teacher, places: Callable[[], Tensor]) -> None:
        """Be taught by ``teacher``.

        Args:
            teacher: Of this run.
            places: Gives the (E, 2) flags of `PLACES` of the present step.

        Raises:
            RomnavError: As `inherit`.
        """
        self.teacher, self.places = teacher, places
        self._entropy: float = self.entropy_coef
        self._divergence = self.symmetry.by_name["divergence"] = Divergence(teacher.spec)
        if teacher.spec.init == "teacher":
            inherit(self.actor, teacher.actor)

    def begin(self, share: float) -> None:
        """Set everything that is scheduled once ``share`` of the run is done."""
        spec = self.teacher.spec
        self._divergence.coefficient, self.symmetry.surrogate = spec.weight(share), spec.ppo(share)
        self.entropy_coef = self._entropy * self.symmetry.surrogate
        # without gradients the optimiser passes the actor by, and its moments stay untouched
        self.actor.requires_grad_(share >= spec.critic_first)

    def act(self, obs: TensorDict) -> Tensor:
        """Actions (E, 3) of the student; what the teacher would have done is kept beside its observations."""
        return super().act(lesson(obs, self.teacher(obs), self.places().float()))

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Tensor]) -> None:
        """Record one step; the teacher forgets the episodes that ended."""
        super().process_env_step(obs, rewards, dones, extras)
        self.teacher.actor.reset(dones)

    def report(self) -> dict[str, float]:
        """Weights of this iteration, and the mean divergence by place since the last report, NaN where nobody was."""
        weights = {"lambda": self._divergence.coefficient, "ppo_weight": self.symmetry.surrogate}
        return weights | self._divergence.by_place()

    def memories(self) -> dict[str, HiddenState]:
        """Of student and teacher."""
        return {**super().memories(), "teacher_memory": self.teacher.actor.get_hidden_state()}

    def remember(self, memories: dict[str, Any]) -> None:
        """Restore `memories`."""
        super().remember(memories)
        self.teacher.actor.reset(hidden_state=memories["teacher_memory"])


def lesson(obs: TensorDict, teacher: Tensor, places: Tensor) -> TensorDict:
    """Observations with the teacher's Beta parameters (E, 2, 3) and the flags (E, 2) of `PLACES`."""
    return TensorDict({**obs, "teacher": teacher, "places": places}, batch_size=obs.batch_size)


def blank_lesson(obs: TensorDict) -> TensorDict:
    """A `lesson` of zeros, as a template for the rollout."""
    (envs,) = obs.batch_size
    return lesson(obs, torch.zeros(envs, 2, ACTIONS, device=obs.device), torch.zeros(envs, 2, device=obs.device))


class Divergence:
    """The divergence from the teacher, as a term of the loss."""

    def __init__(self, spec: KickstartSpec) -> None:
        self._spec = spec
        self.coefficient = spec.weight(0.0)
        self._forget()

    def _forget(self) -> None:
        self._sums = torch.zeros(2, 1 + len(PLACES), dtype=torch.float64)

    def loss(self, actor: MLPModel, batch: RolloutStorage.Batch) -> Tensor:
        """Mean divergence, nat, of the minibatch whose distributions ``actor`` has just computed."""
        student = torch.stack(actor.output_distribution_params, dim=-2)
        teacher = batch.observations["teacher"]
        forward = self._spec.direction == "teacher-student"
        each = beta_divergence(teacher, student) if forward else beta_divergence(student, teacher)
        with torch.no_grad():
            flags = batch.observations["places"]
            same = 1.0 - flags[..., :1]
            where = torch.cat([same, flags], dim=-1).double().flatten(0, -2).cpu()
            counted = torch.stack([each.double().flatten().cpu() @ where, where.sum(0)])
            self._sums += counted
        return each.mean()

    def by_place(self) -> dict[str, float]:
        """Means on the spawn's level and at `PLACES` since they were last asked for, NaN where nobody was."""
        total, count = ranks.total(self._sums)
        means = (total / count).tolist()  # 0 / 0 is NaN
        self._forget()
        return dict(zip([f"divergence_{place}" for place in ("same", *PLACES)], means, strict=True))
