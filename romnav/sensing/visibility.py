"""Which solids a sensor may see from where: lists of candidates per place, never one too few.

A place is a box of sensor positions. A solid is left out of its list where it lies beyond the sensor's range or
vertical field from all of the box, or behind a *screen*: an axis-parallel plane of which solids (a storey's slabs, a
line of walls) cover a part. Every segment from the box to the solid's bounding box crosses the plane inside a
rectangle that interval arithmetic bounds; if all of that rectangle is covered, nothing of the solid is seen from any
position of the place. So an image drawn from the list equals the image drawn from all solids.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from romnav import arrays
from romnav.kernels import wp
from romnav.world.solids import Shape, Solids

wp.set_module_options({"enable_backward": False, "optimization_level": 3, "cpu_compiler_flags": "-march=native -w"})

PLACE = (4.0, 4.0, 2.0)
"""Size of a place, m: storeys are whole numbers of places apart; halving it draws no faster and is longer in making."""
CELL = 0.1
"""Side of the cells in which a screen's covered part is kept, m."""
MAX_SCREENS = 48
"""Largest number of screens of a tile: those that cover most (bounds the time to build)."""
HEADROOM = 2.0
"""Places reach this far above the highest solid's underside that can carry a robot, m."""
SLACK = wp.constant(1.0e-3)
"""By which bounds are widened, m: rounding may not hide what the exact tests would see."""


TYPES = {"first": wp.int32, "corner": wp.vec3, "count": wp.vec3i, "start": wp.int32, "solid": wp.int32}
"""Elements of the arrays of `Places`."""


@wp.struct
class Places:
    """Lists of candidates of every place of every tile; the last place of a tile is everywhere else."""

    first: wp.array(dtype=wp.int32)
    """(T + 1,) first place of each tile."""
    corner: wp.array(dtype=wp.vec3)
    """(T,) least corner of each tile's places, m."""
    count: wp.array(dtype=wp.vec3i)
    """(T,) number of places along each axis."""
    start: wp.array(dtype=wp.int32)
    """(P + 1,) first entry of `solid` of each place."""
    solid: wp.array(dtype=wp.int32)
    """Candidates, numbered over all tiles, in the order of the solids."""
    size: wp.vec3


@wp.func
def place_of(places: Places, tile: int, origin: wp.vec3) -> int:
    """Place in which ``origin`` lies."""
    count = places.count[tile]
    p = wp.cw_div(origin - places.corner[tile], places.size)
    i = int(wp.floor(p[0]))
    j = int(wp.floor(p[1]))
    k = int(wp.floor(p[2]))
    if i < 0 or j < 0 or k < 0 or i >= count[0] or j >= count[1] or k >= count[2]:
        return places.first[tile + 1] - 1
    return places.first[tile] + (i * count[1] + j) * count[2] + k


@wp.struct
class Screen:
    """A plane ``x[axis] = at`` and a table of the covered area of its cells, summed from their least corner."""

    axis: int
    at: float
    u: float
    v: float
    columns: int
    rows: int
    start: int


@wp.func
def _covered(screen: Screen, table: wp.array(dtype=wp.int32), low: wp.vec2, high: wp.vec2) -> bool:
    u0 = int(wp.floor((low[0] - SLACK - screen.u) / CELL))
    v0 = int(wp.floor((low[1] - SLACK - screen.v) / CELL))
    u1 = int(wp.floor((high[0] + SLACK - screen.u) / CELL)) + 1
    v1 = int(wp.floor((high[1] + SLACK - screen.v) / CELL)) + 1
    if u0 < 0 or v0 < 0 or u1 > screen.columns or v1 > screen.rows:
        return False
    stride = screen.rows + 1
    a = screen.start + u0 * stride
    b = screen.start + u1 * stride
    return table[b + v1] - table[b + v0] - table[a + v1] + table[a + v0] == (u1 - u0) * (v1 - v0)


@wp.kernel
def _find(
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
    screens: wp.array(dtype=Screen),
    table: wp.array(dtype=wp.int32),
    corner: wp.vec3,
    count: wp.vec3i,
    size: wp.vec3,
    slopes: wp.vec2,
    max_range: float,
    seen: wp.array2d(dtype=wp.uint8),
):
    place = wp.tid()
    k = place % count[2]
    j = (place / count[2]) % count[1]
    i = place / (count[2] * count[1])
    slack = wp.vec3(SLACK, SLACK, SLACK)
    a = corner + wp.cw_mul(wp.vec3(float(i), float(j), float(k)), size) - slack
    b = a + size + 2.0 * slack
    for s in range(low.shape[0]):
        lo = low[s]
        hi = high[s]
        dx = wp.max(wp.max(lo[0] - b[0], a[0] - hi[0]), 0.0)
        dy = wp.max(wp.max(lo[1] - b[1], a[1] - hi[1]), 0.0)
        near = wp.sqrt(dx * dx + dy * dy)
        dx = wp.max(hi[0] - a[0], b[0] - lo[0])
        dy = wp.max(hi[1] - a[1], b[1] - lo[1])
        far = wp.sqrt(dx * dx + dy * dy)
        visible = (
            near <= max_range
            and lo[2] - b[2] <= wp.max(slopes[1] * near, slopes[1] * far)
            and hi[2] - a[2] >= wp.min(slopes[0] * near, slopes[0] * far)
        )
        n = wp.int32(0)
        while visible and n < screens.shape[0]:
            screen = screens[n]
            n += 1
            axis = screen.axis
            shortest = -1.0
            longest = 0.0
            if b[axis] < screen.at and lo[axis] > screen.at:
                shortest = (screen.at - b[axis]) / (hi[axis] - b[axis])
                longest = (screen.at - a[axis]) / (lo[axis] - a[axis])
            elif a[axis] > screen.at and hi[axis] < screen.at:
                shortest = (a[axis] - screen.at) / (a[axis] - lo[axis])
                longest = (b[axis] - screen.at) / (b[axis] - hi[axis])
            if shortest >= 0.0:
                u = (axis + 1) % 3
                v = (axis + 2) % 3
                first = wp.vec2(a[u], a[v])
                last = wp.vec2(b[u], b[v])
                to_first = wp.vec2(lo[u], lo[v]) - first
                to_last = wp.vec2(hi[u], hi[v]) - last
                visible = not _covered(
                    screen,
                    table,
                    first + wp.min(shortest * to_first, longest * to_first),
                    last + wp.max(shortest * to_last, longest * to_last),
                )
        if visible:
            seen[place, s] = wp.uint8(1)


def find(
    tiles: Sequence[Solids], slopes: tuple[float, float], max_range: float, device: str, cache: Path | None = None
) -> Places:
    """Places of ``tiles`` and what may be seen from them.

    Args:
        tiles: The solids of each tile.
        slopes: Least and largest slope of the sensor's rays.
        max_range: Range of the sensor, m.
        device: Where the lists will be used; they are found on the CPU.
        cache: Folder where they are kept; a stale, foreign or torn file in it is made anew.
    """
    key = _key(tiles, slopes, max_range)
    path = cache / f"visibility-{key}.safetensors" if cache else None
    stored = arrays.load(path) if path else None
    if stored and stored[1] == key and stored[0].keys() == TYPES.keys():
        lists = stored[0]
    else:
        lists = _lists(tiles, slopes, max_range)
        if path:
            arrays.save(path, lists, key)
    places = Places()
    for name, dtype in TYPES.items():
        setattr(places, name, wp.array(lists[name], dtype=dtype, device=device))
    places.size = wp.vec3(*PLACE)
    return places


def _key(tiles: Sequence[Solids], slopes: tuple[float, float], max_range: float) -> str:
    """Digest of everything that the lists depend on, this file included."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    digest.update(json.dumps([slopes, max_range, [len(solids) for solids in tiles]]).encode())
    for solids in tiles:
        for field in fields(solids):
            digest.update(np.ascontiguousarray(getattr(solids, field.name)).data)
    return digest.hexdigest()[:16]


def _lists(tiles: Sequence[Solids], slopes: tuple[float, float], max_range: float) -> dict[str, NDArray]:
    """The arrays of `Places`."""
    size = np.array(PLACE)
    corners, counts, lengths, lists = [], [], [], []
    offset = 0
    for solids in tiles:
        low, high = _bounds(solids)
        corner = np.floor(np.append(low[:, :2].min(0), 0.0) / size) * size
        top = max(solids.top[solids.walkable].max(initial=0.0) + HEADROOM, size[2])
        count = np.ceil((np.append(high[:, :2].max(0), top) - corner) / size).astype(int)
        screens, table = _screens(solids, low, high)
        seen = np.zeros((int(count.prod()) + 1, len(solids)), np.uint8)
        seen[-1] = 1
        inputs: list[Any] = [wp.array(x, dtype=wp.vec3, device="cpu") for x in (low, high)]
        inputs += [wp.array(screens, dtype=Screen, device="cpu"), wp.array(table, dtype=wp.int32, device="cpu")]
        inputs += [wp.vec3(*corner), wp.vec3i(*count.tolist()), wp.vec3(*size), wp.vec2(*slopes), max_range]
        wp.launch(
            _find, len(seen) - 1, [*inputs, wp.array(seen, dtype=wp.uint8, device="cpu", copy=False)], device="cpu"
        )
        lists.append((np.nonzero(seen)[1] + offset).astype(np.int32))
        lengths.append(seen.sum(1, dtype=np.int64))
        corners.append(corner)
        counts.append(count)
        offset += len(solids)
    return {
        "first": np.cumsum([0, *map(len, lengths)], dtype=np.int32),
        "corner": np.array(corners, np.float32),
        "count": np.array(counts, np.int32),
        "start": np.append(0, np.cumsum(np.concatenate(lengths))).astype(np.int32),
        "solid": np.concatenate(lists),
    }


def _bounds(solids: Solids) -> tuple[NDArray, NDArray]:
    """(S, 3) least and greatest corner of the axis-parallel box around each solid."""
    c, s = np.abs(np.cos(solids.yaw)), np.abs(np.sin(solids.yaw))
    u, v = solids.half.T
    disc = solids.shape == Shape.CYLINDER
    reach = np.stack([np.where(disc, u, c * u + s * v), np.where(disc, u, s * u + c * v)], axis=1) + 1e-4
    low = solids.bottom - np.abs(solids.slope_bottom) * u - 1e-4
    high = solids.top + np.abs(solids.slope_top) * u + 1e-4
    return np.column_stack([solids.centre - reach, low]), np.column_stack([solids.centre + reach, high])


class _Sheet(NamedTuple):
    axis: int
    at: float
    corner: NDArray
    covered: NDArray[np.bool_]


def _screens(solids: Solids, low: NDArray, high: NDArray) -> tuple[NDArray, NDArray[np.int32]]:
    """The screens of a tile, those that cover most first, and their tables."""
    turned = np.abs(np.sin(2 * solids.yaw)) > 1e-9
    whole = (solids.shape == Shape.BOX) & ~turned & (solids.slope_bottom == 0) & (solids.slope_top == 0)
    low, high = low[whole] + 1e-4, high[whole] - 1e-4
    planes = []
    for axis in range(3):
        others = [(axis + 1) % 3, (axis + 2) % 3]
        thin = (high - low).argmin(1) == axis
        for at in np.unique(np.round((low[thin, axis] + high[thin, axis]) / 2, 3)):
            cut = (low[:, axis] < at) & (high[:, axis] > at)
            rectangles = low[cut][:, others], high[cut][:, others]
            planes.append((float((rectangles[1] - rectangles[0]).prod(1).sum()), axis, float(at), *rectangles))
    planes.sort(key=lambda plane: -plane[0])
    sheets = [_sheet(*plane[1:]) for plane in planes[:MAX_SCREENS] if plane[0] > 0]
    screens = np.zeros(len(sheets), Screen.numpy_dtype())
    tables = [np.pad(s.covered.cumsum(0, np.int32).cumsum(1, np.int32), ((1, 0), (1, 0))) for s in sheets]
    for row, sheet in zip(screens, sheets, strict=True):
        row["axis"], row["at"], (row["u"], row["v"]) = sheet.axis, sheet.at, sheet.corner
        row["columns"], row["rows"] = sheet.covered.shape
    screens["start"] = np.cumsum([0, *(t.size for t in tables)])[:-1]
    return screens, np.concatenate([t.ravel() for t in tables]) if tables else np.zeros(1, np.int32)


def _sheet(axis: int, at: float, low: NDArray, high: NDArray) -> _Sheet:
    """Cells of a plane that lie wholly in the union of the rectangles ``low`` (R, 2) to ``high``."""
    lines = [np.unique(np.round(np.concatenate([low[:, k], high[:, k]]), 6)) for k in range(2)]
    union = np.zeros((len(lines[0]) - 1, len(lines[1]) - 1), np.int32)
    for a, b in zip(np.round(low, 6), np.round(high, 6), strict=True):
        (u0, u1), (v0, v1) = (np.searchsorted(lines[k], (a[k], b[k])) for k in range(2))
        union[u0:u1, v0:v1] = 1
    total = np.pad(union.cumsum(0, np.int32).cumsum(1, np.int32), ((1, 0), (1, 0)))
    corner = np.array([line[0] for line in lines])
    span = []
    for k, line in enumerate(lines):
        edge = corner[k] + CELL * np.arange(int((line[-1] - line[0]) / CELL) + 1)
        # parts of the lines that a cell overlaps
        span.append((np.searchsorted(line, edge[:-1] + 1e-6, "right") - 1, np.searchsorted(line, edge[1:] - 1e-6)))
    (u0, u1), (v0, v1) = ((a[:, None] if k == 0 else a, b[:, None] if k == 0 else b) for k, (a, b) in enumerate(span))
    filled = total[u1, v1] - total[u0, v1] - total[u1, v0] + total[u0, v0]
    return _Sheet(axis, at, corner, filled == (u1 - u0) * (v1 - v0))
