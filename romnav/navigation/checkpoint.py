"""Trained policies on disk: what made them, and errors a user can act on."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from tensordict import TensorDict

from romnav import parts
from romnav.errors import RomnavError
from romnav.navigation.policy import BEARING, NavigationActor
from romnav.navigation.ppo import PrivilegedCritic, make_actor, make_critic
from romnav.navigation.spec import NavigationSpec
from romnav.sensing.encoder import Encoder
from romnav.tensors import Kind, require_finite

KIND = Kind("romnav-policy-1", "policy", "train the arm by `romnav train policy`")
"""Policies, and the states of unfinished runs."""
save, read = KIND.save, KIND.load


def load_spec(path: Path) -> NavigationSpec:
    """What the policy of ``path`` was trained with.

    Raises:
        RomnavError: As `read`; it is invalid.
    """
    return _spec(path, read(path))


def _spec(path: Path, content: dict[str, Any]) -> NavigationSpec:
    try:
        return NavigationSpec.model_validate_json(content["spec"], context=parts.SAVED)
    except ValidationError as error:
        first = error.errors()[0]
        raise RomnavError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}; train the arm again") from error


def load_critic(path: Path) -> PrivilegedCritic | None:
    """The critic that the policy of ``path`` was trained with, in evaluation mode; None if it is not in the file.

    Raises:
        RomnavError: As `read`; its weights are not finite or of another shape.
    """
    content = read(path)
    if "critic" not in content:
        return None
    again, weights = "train the arm again", content["critic"]
    try:
        spec = NavigationSpec.model_validate_json(content["spec"], context=parts.SAVED)
        seen = torch.zeros(1, weights["mlp.0.weight"].shape[1])
        critic = make_critic(TensorDict({"critic": seen}, batch_size=[1]), spec.policy)
        critic.load_state_dict(weights)
    except (KeyError, ValueError, RuntimeError) as error:
        raise RomnavError(f"{path}: key 'critic' is of another architecture; {again}") from error
    require_finite(path, weights, again)
    return critic.eval()


def load_actor(
    path: Path, encoder: Encoder, device: str = "cpu", *, depth_encoder: Encoder | None = None
) -> NavigationActor:
    """The policy of ``path`` for the tokens of ``encoder`` and ``depth_encoder``, in evaluation mode.

    One that trained its encoder has a copy of ``encoder`` with its own weights. One without a depth camera needs no
    ``depth_encoder``.

    Raises:
        RomnavError: As `read`; the policy was trained with another encoder; its weights do not fit its spec or are not
            finite.
    """
    content = read(path, device)
    own = any(name.startswith("encoder.") for name in content["actor"])
    has_depth = content.get("depth_encoder") is not None
    used = {"encoder": None if own else encoder, "depth_encoder": depth_encoder if has_depth else None}
    for key, given in used.items():
        if given is not None and content[key] != given.digest():
            raise RomnavError(
                f"{path}: key '{key}' is {content[key]}, but the encoder at hand is {given.digest()}; "
                "train the arm again or restore the encoder it was trained with"
            )
    if has_depth and depth_encoder is None:
        raise RomnavError(f"{path}: the policy sees through a depth camera; drive it on the humanoid that has one")
    spec = _spec(path, content)
    try:
        state = content["actor"]["state_embedding.0.weight"].shape[1] - BEARING
        seen = {"lidar": torch.zeros(1, *encoder.token_shape), "state": torch.zeros(1, state)}
        if has_depth and depth_encoder is not None:
            seen["depth"] = torch.zeros(1, *depth_encoder.token_shape)
        actor = make_actor(TensorDict(seen, batch_size=[1]), spec.policy, guided=spec.ppo.guidance > 0.0)
        if own:
            actor.encoder = copy.deepcopy(encoder)
        actor.load_state_dict(content["actor"])
    except RuntimeError as error:
        reason = str(error).splitlines()[1].strip()
        raise RomnavError(f"{path}: a policy of another architecture ({reason}); train the arm again") from error
    require_finite(path, content["actor"], "train the arm again")
    return actor.to(device).eval()
