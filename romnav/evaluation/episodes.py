"""The paired set of initial conditions: a versioned file with a hash (paper, Sec. IV-A)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from torch import Tensor

from romnav import files
from romnav.errors import RomnavError
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.progress import Progress
from romnav.world.build import build
from romnav.world.geodesic import UNIT
from romnav.world.spawns import Start, is_cross_level, sample
from romnav.world.spec import WorldSpec
from romnav.world.world import World

VERSION = 1
CANDIDATES = 16
"""Draws per episode of a set."""
COLUMNS = (
    ("tile", 0),
    ("layer", 0),
    ("spawn_x", 3),
    ("spawn_y", 3),
    ("spawn_z", 3),
    ("spawn_yaw", 4),
    ("goal", 0),
    ("goal_x", 3),
    ("goal_y", 3),
    ("goal_z", 3),
    ("goal_yaw", 4),
    ("geodesic", 3),
)
"""Columns of the file and the decimals they are stored with; metres and radians."""


@dataclass(frozen=True)
class EpisodeSet:
    """``n`` episodes on the tiles of ``world``; ``columns`` maps each name of `COLUMNS` to an array (n,)."""

    name: str
    world: WorldSpec
    columns: dict[str, NDArray]

    def __len__(self) -> int:
        return len(self.columns["tile"])

    @property
    def digest(self) -> str:
        """Hash of terrain and episodes; rows with different hashes are never compared."""
        text = json.dumps([VERSION, self.world.model_dump(mode="json"), _plain(self.columns)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def cross(self) -> NDArray[np.bool_]:
        """(n,) whether start and goal lie on different levels."""
        z = [torch.from_numpy(self.columns[k]) for k in ("spawn_z", "goal_z")]
        return is_cross_level(*z).numpy()

    def start(self, device: str) -> Start:
        """The episodes as initial conditions on ``device``."""
        c = self.columns

        def tensor(*names: str, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            columns = [torch.from_numpy(c[name]).to(device, dtype) for name in names]
            return columns[0] if len(columns) == 1 else torch.stack(columns, dim=1)

        return Start(
            tile=tensor("tile", dtype=torch.int64),
            layer=tensor("layer", dtype=torch.int64),
            xy=tensor("spawn_x", "spawn_y"),
            yaw=tensor("spawn_yaw"),
            goal=tensor("goal", dtype=torch.int64),
            goal_yaw=tensor("goal_yaw"),
        )


def draw(name: str, spec: EpisodeSetSpec, world: World) -> EpisodeSet:
    """Draw a set on ``world``, built from ``spec.world``: tiles in turn, the sampler's spawns and goals.

    Of the draws that start off stairs, ramps and their mouths, with a goal within the cap, the first ``spec.cross``
    across levels and the first others on one level are taken, in the order in which they were drawn.

    Raises:
        RomnavError: Too few draws qualify.
    """
    candidate = torch.arange(CANDIDATES * spec.episodes)
    tile = candidate % len(world.tiles)
    start = sample(world, spec.sampler, spec.seed, tile, candidate, torch.zeros_like(candidate))
    node = world.node_at(start.tile, start.layer, start.xy)
    fits = ~torch.isin(node, world.spawn) & (geodesic(world, start) <= spec.sampler.max_distance)
    cross = is_cross_level(world.position[node, 2], world.position[world.goal[start.goal], 2])
    strata = [(fits & cross, spec.cross), (fits & ~cross, spec.episodes - spec.cross)]
    if any(int(stratum.sum()) < count for stratum, count in strata):
        raise RomnavError(
            f"{name}: of {len(candidate)} draws {int(strata[0][0].sum())} across levels and "
            f"{int(strata[1][0].sum())} on one level qualify; lower 'episodes' or 'cross', or raise goals_per_tile"
        )
    taken = torch.cat([stratum.nonzero()[:count, 0] for stratum, count in strata]).sort().values
    start = Start(**{key: value[taken] for key, value in vars(start).items()})
    return of(name, world, start)


def of(name: str, world: World, start: Start) -> EpisodeSet:
    """The set of given starts on ``world``."""
    goal = world.position[world.goal[start.goal]]
    values = {
        "tile": start.tile,
        "layer": start.layer,
        "spawn_x": start.xy[:, 0],
        "spawn_y": start.xy[:, 1],
        "spawn_z": world.surface(start.tile, start.layer, start.xy),
        "spawn_yaw": start.yaw,
        "goal": start.goal,
        "goal_x": goal[:, 0],
        "goal_y": goal[:, 1],
        "goal_z": goal[:, 2],
        "goal_yaw": start.goal_yaw,
        "geodesic": geodesic(world, start),
    }
    columns = {
        key: values[key].numpy() if decimals == 0 else np.round(values[key].numpy().astype(np.float64), decimals)
        for key, decimals in COLUMNS
    }
    return EpisodeSet(name, world.spec, columns)


def geodesic(world: World, start: Start) -> Tensor:
    """(E,) float64 shortest path from the cell of each start to its goal, m."""
    node = world.node_at(start.tile, start.layer, start.xy)
    offset = world.field_start[start.goal] + node - world.node_start[start.tile]
    return world.fields[offset].to(torch.float64) * UNIT


def save(path: Path, episodes: EpisodeSet) -> None:
    """Write a set as JSON, one column a line."""
    head = {"version": VERSION, "hash": episodes.digest, "world": episodes.world.model_dump(mode="json")}
    lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in (head | _plain(episodes.columns)).items()]
    files.write(path, "{\n" + ",\n".join(lines) + "\n}\n")


def load(path: Path) -> EpisodeSet:
    """Read a set.

    Raises:
        RomnavError: The file is missing or torn, or its content does not have the hash that it states.
    """
    try:
        data: dict[str, Any] = json.loads(path.read_text("utf-8"))
        stated = data.pop("hash")
        version = data.pop("version")
        world = WorldSpec.model_validate_json(json.dumps(data.pop("world")))
        columns = {key: np.array(data[key], np.int64 if d == 0 else np.float64) for key, d in COLUMNS}
    except FileNotFoundError:
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.json"))) or "none"
        raise RomnavError(f"{path}: no such episode set; there are: {known}") from None
    except (OSError, json.JSONDecodeError, KeyError, TypeError, ValueError, ValidationError) as error:
        raise RomnavError(f"{path}: not an episode set ({error!r}); restore it from version control") from error
    if version != VERSION:
        raise RomnavError(f"{path}: key 'version' is {version}, this romnav reads {VERSION}; use a matching release")
    episodes = EpisodeSet(path.stem, world, columns)
    if episodes.digest != stated:
        raise RomnavError(
            f"{path}: key 'hash' is {stated}, but the content hashes to {episodes.digest}: it was edited; "
            "restore it from version control"
        )
    return episodes


def terrain(episodes: EpisodeSet, path: Path, cache: Path | None, progress: Progress | None = None) -> World:
    """The tiles of a set, checked to be the ones that it was drawn on.

    Raises:
        RomnavError: A spawn or goal of the set is not free on these tiles, or its geodesic differs: the set was
            drawn by another version of the generator.
    """
    world = build(episodes.world, cache, progress)
    start = episodes.start("cpu")
    node = world.node_at(start.tile, start.layer, start.xy)
    goal = start.goal.clamp(max=len(world.goal) - 1)
    position = world.position[world.goal[goal]].double().numpy()
    stored = np.stack([episodes.columns[k] for k in ("goal_x", "goal_y", "goal_z")], axis=1)
    offset = world.field_start[goal] + node.clamp(min=0) - world.node_start[start.tile]
    inside = offset.clamp(0, len(world.fields) - 1)
    length = world.fields[inside].to(torch.float64).numpy() * UNIT
    wrong = (
        (node < 0).numpy()
        | (np.abs(position - stored).max(axis=1) > 2e-3)
        | (np.abs(length - episodes.columns["geodesic"]) > 2e-3)
    )
    if wrong.any():
        raise RomnavError(
            f"{path}: episode {int(np.flatnonzero(wrong)[0])} does not fit its terrain ({int(wrong.sum())} of "
            f"{len(episodes)} do not): the set was drawn by another world generator; use that version of romnav"
        )
    return world


def _plain(columns: dict[str, NDArray]) -> dict[str, list]:
    return {key: columns[key].tolist() for key, _ in COLUMNS}
