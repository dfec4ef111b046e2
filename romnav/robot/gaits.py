"""The gait library: states of the walking robot on stairs and ramps, to start episodes there (paper, Sec. III-D)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from romnav.errors import RomnavError
from romnav.robot.g1 import Humanoids
from romnav.robot.locomotion.control import Controller, has_fallen
from romnav.robot.locomotion.planar import heading_of, turn_xy, wrap
from romnav.robot.locomotion.terrain import Ground, Lane, Slab, ramp, stairs, steer
from romnav.robot.locomotion.train import load_policy
from romnav.tensors import Kind

KIND = Kind("romnav-gaits-1", "gait library", "record one with `romnav train gaits`")
COMMAND = 0.5
"""Standard command along the slope, m/s."""
_POINTS = ("lift", "foothold", "planted")


@dataclass(frozen=True)
class Gait:
    """One recorded walk over a slope, each frame relative to its anchor.

    The anchor is the middle of the tread the stance foot stands on, on its surface (on a ramp, the point under
    the stance sole), with x up or down the slope in the direction of walking.

    Attributes:
        kind: "stair" or "ramp".
        direction: +1 up, -1 down.
        slope: rise over run, > 0.
        frames: tensors of `Controller.snapshot`, (frames, ...).
    """

    kind: str
    direction: int
    slope: float
    frames: dict[str, Tensor]

    def __len__(self) -> int:
        return len(self.frames["clock"])


def move(state: dict[str, Tensor], turn: Tensor, shift: Tensor) -> dict[str, Tensor]:
    """Rotate states about z by `turn` (k,), then move them by `shift` (k, 3)."""
    state = {name: value.clone() for name, value in state.items()}
    for name in _POINTS:
        state[name] = torch.cat([turn_xy(state[name][:, :2], turn), state[name][:, 2:]], dim=1) + shift
    state["base"] = state["base"] + shift[:, 2]
    state["heading"] = wrap(state["heading"] + turn)
    q, v, turn = state["qpos"], state["qvel"], turn.double()
    q[:, :2] = turn_xy(q[:, :2], turn)
    q[:, :3] += shift.double()
    c, s = torch.cos(turn / 2), torch.sin(turn / 2)
    w, x, y, z = q[:, 3:7].clone().unbind(1)
    q[:, 3:7] = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], dim=1)
    v[:, :2] = turn_xy(v[:, :2], turn)
    return state


class GaitLibrary:
    """Recorded gaits, looked up by kind, direction and slope."""

    def __init__(self, gaits: list[Gait]) -> None:
        self.gaits = gaits

    def has(self, kind: str, direction: int) -> bool:
        """Whether there is a walk up (+1) or down (-1) a slope of that kind."""
        return any(gait.kind == kind and gait.direction == direction for gait in self.gaits)

    def nearest(self, kind: str, direction: int, slope: float) -> Gait:
        """The gait of the nearest slope.

        Raises:
            RomnavError: none of that kind and direction was recorded.
        """
        found = [gait for gait in self.gaits if gait.kind == kind and gait.direction == direction]
        if not found:
            way = "up" if direction > 0 else "down"
            raise RomnavError(f"gait library: no walk {way} a {kind}; record it with a policy that crosses one")
        return min(found, key=lambda gait: abs(gait.slope - slope))

    def place(
        self,
        control: Controller,
        ids: Tensor,
        gaits: Sequence[Gait],
        frame: Tensor,
        anchor: Tensor,
        heading: Tensor,
    ) -> None:
        """Start robots `ids` within gaits.

        Args:
            control: of the robots.
            ids: (k,).
            gaits: of each, from `nearest`.
            frame: (k,) times along them.
            anchor: (k, 3) middle of the tread to stand on (of a ramp: any point of it), m.
            heading: (k,) of walking, rad.
        """
        picked = {
            name: torch.stack([gait.frames[name][k] for gait, k in zip(gaits, frame.tolist(), strict=True)])
            for name in gaits[0].frames
        }
        control.restore(ids, move(picked, heading, anchor))

    def save(self, path: Path) -> None:
        """Write all gaits to one file."""
        KIND.save(path, {"gaits": [vars(gait) for gait in self.gaits]})

    @classmethod
    def load(cls, path: Path) -> GaitLibrary:
        """Read what `save` wrote.

        Raises:
            RomnavError: the file is missing, damaged or no gait library.
        """
        return cls([Gait(**fields) for fields in KIND.load(path)["gaits"]])


def library_lanes() -> list[Lane]:
    """Slopes of the library: risers and treads over the range of the tiles, ramps to 15 degrees."""
    shapes = ((0.10, 0.32), (0.12, 0.30), (0.14, 0.29), (0.16, 0.28), (0.18, 0.26))
    lanes = [stairs(i, riser, tread, tread, 10) for i, (riser, tread) in enumerate(shapes)]
    return lanes + [ramp(i, degrees, 4.0) for i, degrees in enumerate((5.0, 8.0, 11.0, 14.0))]


def record(checkpoint: Path, *, per_slope: int = 4, threads: int = 0) -> GaitLibrary:
    """Walk a policy up and down the slopes of the library and keep every walk that arrives.

    Args:
        checkpoint: of the policy.
        per_slope: walks tried for each slope and direction; the first that arrives is kept.
        threads: of the physics.
    """
    spec, policy, _ = load_policy(checkpoint)
    lanes = library_lanes()
    ground = Ground(lanes)
    n = 2 * per_slope * len(lanes)
    index = torch.arange(n)
    lane, direction = index % len(lanes), torch.where((index // len(lanes)) % 2 == 0, 1, -1)
    robots = Humanoids(spec.robot, [ground.geoms], n, threads=threads)
    control = Controller(spec, robots)
    start = torch.where(direction > 0, ground.spawn[lane, 0], ground.spawn[lane, 1])
    goal = torch.where(direction > 0, ground.spawn[lane, 1], ground.spawn[lane, 2])
    at = ground.at(lane, start)
    z = ground.map(at, torch.full((n,), 99.0))
    random = torch.Generator().manual_seed(0)
    clock = torch.randint(0, 2, (n,), generator=random) * spec.gait.step_ticks
    speed, forward, arc = torch.full((n,), COMMAND), torch.ones(n), start.clone()
    command = torch.stack([speed, 0 * speed, 0 * speed], dim=1)
    control.stand(index, torch.cat([at, z[:, None]], dim=1), torch.zeros(n), clock, command)
    fell, arrived = torch.zeros(n, dtype=torch.bool), torch.zeros(n, dtype=torch.bool)
    frames: list[dict[str, Tensor]] = []
    soles: list[Tensor] = []
    for tick in range(int(2.0 * float((goal - start).max()) / COMMAND / control.dt)):
        xy = robots.pelvis[:, :2]
        arc = ground.project(lane, xy, arc)
        command = steer(ground, lane, arc, forward, xy, heading_of(robots.orientation), speed)
        frames.append(control.snapshot(index))
        ref = control.refer(command, ground.map, torch.full((n,), tick == 0))
        soles.append(ref.sole[index, (ref.side < 0).long()])
        control.act(policy(control.observe(command, ground.map)))
        fell |= has_fallen(robots)
        arrived |= ~fell & (goal - arc < 0.3)
        if (fell | arrived).all():
            break
    states = {name: torch.stack([frame[name] for frame in frames]) for name in frames[0]}
    stance = torch.stack(soles)
    gaits: list[Gait] = []
    for i in index[arrived].tolist():
        shape = (int(lane[i]), int(direction[i]))
        if all((g.kind, g.direction, g.slope) != _label(lanes, *shape) for g in gaits):
            gaits.append(_cut(lanes, ground, *shape, {k: v[:, i] for k, v in states.items()}, stance[:, i]))
    return GaitLibrary(gaits)


def still_up(
    checkpoint: Path, library: GaitLibrary, *, trials: int = 400, seconds: float = 3.0, seed: int = 0, threads: int = 0
) -> float:
    """Share of robots still up after walking on from a state of the library, where episodes would take it from.

    Each is put at a random time of the nearest gait on a random tread of a flight or ramp whose slope is not in the
    library, and walks on under the standard command.

    Args:
        checkpoint: of the policy.
        library: recorded from it.
        trials: robots, spread over slopes and directions that the library has.
        seconds: of walking.
        seed: of treads and times.
        threads: of the physics.

    Raises:
        RomnavError: the library is empty.
    """
    spec, policy, _ = load_policy(checkpoint)
    shapes = ((0.11, 0.31), (0.13, 0.28), (0.15, 0.30), (0.17, 0.27))
    lanes = [stairs(i, riser, tread, tread, 20) for i, (riser, tread) in enumerate(shapes)]
    lanes += [ramp(i, degrees, 6.0) for i, degrees in enumerate((6.5, 9.5, 12.5))]
    known = [way for way in itertools.product(range(len(lanes)), (1, -1)) if library.has(*_label(lanes, *way)[:2])]
    if not known:
        raise RomnavError("gait library: empty; record it with a policy that crosses stairs or ramps")
    ground = Ground(lanes)
    robots = Humanoids(spec.robot, [ground.geoms], trials, threads=threads)
    control = Controller(spec, robots)
    random = torch.Generator().manual_seed(seed)
    index, lane, start = torch.arange(trials), torch.zeros(trials, dtype=torch.long), torch.zeros(trials)
    for i, where, when in zip(
        index, torch.rand(trials, generator=random), torch.rand(trials, generator=random), strict=True
    ):
        which, direction = known[int(i) % len(known)]
        kind, _, slope = _label(lanes, which, direction)
        slabs = _flight(lanes[which], direction)
        if kind == "stair":
            slab = slabs[int(where * (len(slabs) - 7))]
            x, z = (slab.x0 + slab.x1) / 2, slab.z0
        else:
            part = 0.1 + 0.5 * float(where)
            x, z = slabs[0].x0 + part * (slabs[0].x1 - slabs[0].x0), slabs[0].z0 + part * (slabs[0].z1 - slabs[0].z0)
        gait = library.nearest(kind, direction, slope)
        anchor = torch.tensor([[x, float(ground.path[which, 0, 1]), z]])
        library.place(control, i[None], [gait], (when * len(gait)).long()[None], anchor, torch.zeros(1))
        lane[i], start[i] = which, x
    arc, forward, speed = start, torch.ones(trials), torch.full((trials,), COMMAND)
    fell = torch.zeros(trials, dtype=torch.bool)
    for _ in range(round(seconds / control.dt)):
        xy = robots.pelvis[:, :2]
        arc = ground.project(lane, xy, arc)
        command = steer(ground, lane, arc, forward, xy, heading_of(robots.orientation), speed)
        control.refer(command, ground.map, torch.zeros(trials, dtype=torch.bool))
        control.act(policy(control.observe(command, ground.map)), (~fell).nonzero()[:, 0])
        fell |= has_fallen(robots)
    return 1.0 - fell.float().mean().item()


def _flight(lane: Lane, direction: int) -> list[Slab]:
    """The slabs of the way up or down, without the landing."""
    slabs = [s for s in lane.slabs if (s.x0 + s.x1) / 2 < lane.spawns[1] - 0.1]
    return slabs if direction > 0 else lane.slabs[len(slabs) + 1 :]


def _label(lanes: list[Lane], lane: int, direction: int) -> tuple[str, int, float]:
    """Kind, direction and slope of a flight."""
    first, second = _flight(lanes[lane], direction)[0], _flight(lanes[lane], direction)[-1]
    run = first.x1 - first.x0
    if lanes[lane].kind == "ramp":
        return "ramp", direction, abs(first.z1 - first.z0) / run
    return "stair", direction, abs(second.z0 - first.z0) / (second.x0 - first.x0)


def _cut(
    lanes: list[Lane], ground: Ground, lane: int, direction: int, states: dict[str, Tensor], stance: Tensor
) -> Gait:
    """The frames (t, ...) of a walk in which the stance sole, (t, 3), is on the flight, relative to its anchor."""
    slabs = _flight(lanes[lane], direction)
    x0, x1 = (torch.tensor([getattr(s, name) for s in slabs]) for name in ("x0", "x1"))
    on = (stance[:, :1] > x0) & (stance[:, :1] < x1)
    keep = on.any(1)
    anchor = stance[keep].clone()
    if lanes[lane].kind == "stairs":
        anchor[:, 0] = ((x0 + x1) / 2)[on[keep].long().argmax(1)]
    anchor[:, 1] = ground.path[lane, 0, 1]
    anchor[:, 2] = ground.map(stance[keep, :2], torch.full((len(anchor),), 99.0))
    frames = move({name: value[keep] for name, value in states.items()}, torch.zeros(len(anchor)), -anchor)
    return Gait(*_label(lanes, lane, direction), frames)
