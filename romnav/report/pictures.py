"""Pictures of tiles: the paper's environment figure, a tile in 3D beside its occupancy grids."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from romnav.world.grids import Grids
from romnav.world.mesh import Mesh, triangulate
from romnav.world.solids import Label, Shape, Solids
from romnav.world.tile import Tile

COLOURS = {
    Label.GROUND: "#e4dfd3",
    Label.OBSTACLE: "#7d8da3",
    Label.STAIR: "#e69f00",
    Label.RAMP: "#2a9d78",
}
WALL = "#aab4c0"
OCCUPIED = "#49566a"
PATH = "#b2182b"
PANE = 0.22
"""Opacity of walls and upper floors."""
MARGIN = 10.0
"""Around a rendered tile, pixels."""
LIGHT = np.array([0.30, 0.45, 0.84])


def draw_tile(tile: Tile, grids: Grids, path: Path, *, azimuth: float = -60.0, elevation: float = 38.0) -> None:
    """Draw ``tile`` in 3D beside the grid of every layer and save it to ``path`` (type by its suffix).

    Walls and upper floors are translucent. Angles in degrees, of the viewer seen from the tile's centre.
    """
    layers = len(tile.layers)
    columns = min(layers, 3)
    rows = -(-layers // columns)
    figure = Figure(figsize=(9.0 + 2.2 * columns, 6.2), layout="constrained")
    spec = figure.add_gridspec(rows, columns + 1, width_ratios=[1.0 + 0.4 * columns, *[1.0] * columns])
    axes = figure.add_subplot(spec[:, 0])
    axes.imshow(render(tile, azimuth, elevation))
    axes.set_axis_off()
    axes.set_title(f"{tile.kind} {tile.index}")
    for layer in range(layers):
        draw_grid(figure.add_subplot(spec[layer // columns, 1 + layer % columns]), tile, grids, layer)
    handles = [Patch(color=COLOURS[k], label=k.name.lower()) for k in (Label.GROUND, Label.STAIR, Label.RAMP)]
    handles += [
        Patch(color=OCCUPIED, label="occupied"),
        Patch(color=PATH, label="stair and ramp centre lines"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.savefig(path, dpi=150)


def draw_grid(axes: Axes, tile: Tile, grids: Grids, layer: int) -> None:
    """Draw the free and occupied cells of a layer, with the centre lines of the stairs and ramps that touch it."""
    height, label, free = grids.height[layer], grids.label[layer], grids.free[layer]
    image = np.ones((*height.shape, 3))
    image[label >= 0] = to_rgb(OCCUPIED)
    for kind in (Label.GROUND, Label.STAIR, Label.RAMP):
        image[free & (label == kind)] = to_rgb(COLOURS[kind])
    if len(tile.layers) == 1 and np.nanmax(height) > np.nanmin(height):
        shade = 1.0 - 0.35 * (height - np.nanmin(height)) / (np.nanmax(height) - np.nanmin(height))
        image[free] *= shade[free, None]
    extent = (0.0, tile.side, 0.0, tile.side)
    axes.imshow(image.transpose(1, 0, 2), origin="lower", extent=extent, interpolation="nearest")
    for connector in tile.connectors:
        if connector.layers[0] <= layer <= connector.layers[1]:
            axes.plot(*connector.path[:, :2].T, color=PATH, linewidth=1.2)
            axes.plot(*connector.path[-1, :2], marker="o", markersize=3, color=PATH)
    name = f"floor {tile.storeys.index(layer)}" if layer in tile.storeys else "landings"
    title = f"{name}, z = {tile.layers[layer]:.1f} m" if tile.multi_story else "occupancy"
    axes.set_title(title, fontsize=9)
    axes.locator_params(nbins=5)
    axes.tick_params(labelsize=7)


def render(tile: Tile, azimuth: float, elevation: float, pixels: int = 1000) -> NDArray[np.float64]:
    """(H, W, 3) orthographic image of ``tile`` with walls and upper floors translucent."""
    solids = tile.solids
    mesh = triangulate(solids, segments=20)
    glass = _see_through(solids)
    colour = np.array([to_rgb(COLOURS[Label(k)]) for k in solids.label])
    colour[glass & (solids.label == Label.OBSTACLE)] = to_rgb(WALL)
    points, normals = _view(mesh, np.radians(azimuth), np.radians(elevation))
    low, scale, (width, high) = _frame(points, pixels)
    points = np.concatenate([(points[..., :2] - low) * scale + MARGIN, points[..., 2:] * scale], axis=2)
    facing = normals @ _toward(np.radians(azimuth), np.radians(elevation)) > 1e-9
    shade = 0.62 + 0.38 * np.clip(normals @ LIGHT, 0.0, 1.0)
    paint = np.clip(colour[mesh.solid] * shade[:, None], 0.0, 1.0)

    image = np.ones((high, width, 3))
    depth = np.full((high, width), -np.inf)
    owner = np.full((high, width), -1)
    fragments = []
    for t in np.flatnonzero(facing):
        rows, cols, z = _fragments(points[t], width, high)
        if glass[mesh.solid[t]]:
            fragments.append((rows, cols, z, np.full(len(rows), t)))
            continue
        seen = z > depth[rows, cols]
        rows, cols = rows[seen], cols[seen]
        depth[rows, cols], owner[rows, cols] = z[seen], mesh.solid[t]
        image[rows, cols] = paint[t]
    edge = np.zeros((high, width), bool)
    edge[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    edge[1:] |= owner[1:] != owner[:-1]
    image[edge] *= 0.72
    if fragments:
        row, col, near, face = (np.concatenate(part) for part in zip(*fragments, strict=True))
        pixel = row * width + col
        order = np.lexsort((near, pixel))
        order = order[near[order] > depth[row[order], col[order]]]
        pixel, face = pixel[order], face[order]
        first = np.flatnonzero(np.diff(pixel, prepend=-1))
        rank = np.arange(len(pixel)) - np.repeat(first, np.diff(first, append=len(pixel)))
        flat = image.reshape(-1, 3)
        for k in range(int(rank.max(initial=-1)) + 1):  # the farthest pane of every pixel first
            at = pixel[rank == k]
            flat[at] += PANE * (paint[face[rank == k]] - flat[at])
    return image[::-1]


def project(
    tile: Tile, points: NDArray[np.float64], azimuth: float, elevation: float, pixels: int = 1000
) -> NDArray[np.float64]:
    """(P, 2) column and row, in the image that `render` makes of ``tile``, of ``points`` (P, 3), m."""
    corners, _ = _view(triangulate(tile.solids, segments=20), np.radians(azimuth), np.radians(elevation))
    low, scale, (_, high) = _frame(corners, pixels)
    seen = points @ _basis(np.radians(azimuth), np.radians(elevation))
    x, y = ((seen[:, :2] - low) * scale + MARGIN).T
    return np.stack([x - 0.5, high - y - 0.5], axis=1)


def _frame(points: NDArray[np.float64], pixels: int) -> tuple[NDArray[np.float64], float, tuple[int, int]]:
    """Lower corner, pixels per metre, and width and height in pixels of what (T, 3, 3) corners cover."""
    span = np.ptp(points[..., :2], axis=(0, 1))
    scale = (pixels - 2 * MARGIN) / float(span.max())
    width, high = (int(n) for n in np.ceil(span * scale + 2 * MARGIN))
    return points[..., :2].min(axis=(0, 1)), scale, (width, high)


def _see_through(solids: Solids) -> NDArray[np.bool_]:
    """(S,) walls and upper floors."""
    extent, tall = 2.0 * solids.half, solids.top - solids.bottom
    thin = extent.min(axis=1)
    wall = (solids.shape == Shape.BOX) & ~solids.walkable & (extent.max(axis=1) > 0.55) & (thin < 0.32)
    wall &= ((tall > 0.85) & (thin > 0.12)) | (tall > 2.5)
    upper = (solids.layers[:, 0] > 0) & (solids.label == Label.GROUND) & (solids.layers[:, 0] % 2 == 0)
    return wall | upper


def _toward(azimuth: float, elevation: float) -> NDArray[np.float64]:
    c = np.cos(elevation)
    return np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])


def _view(mesh: Mesh, azimuth: float, elevation: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (T, 3, 3) as right, up and toward the viewer; outward unit normals (T, 3) in the tile frame."""
    corners = mesh.corners
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    norm = np.linalg.norm(normal, axis=1, keepdims=True)
    return corners @ _basis(azimuth, elevation), normal / np.maximum(norm, 1e-12)


def _basis(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Columns: right, up and toward the viewer."""
    toward = _toward(azimuth, elevation)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(toward, right), toward], axis=1)


def _fragments(
    corner: NDArray[np.float64], width: int, high: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Rows, columns and depths of the pixel centres inside a projected triangle."""
    low = np.maximum(np.ceil(corner[:, :2].min(axis=0) - 0.5), 0).astype(int)
    top = np.minimum(np.floor(corner[:, :2].max(axis=0) - 0.5), (width - 1, high - 1)).astype(int)
    x, y = np.meshgrid(np.arange(low[0], top[0] + 1) + 0.5, np.arange(low[1], top[1] + 1) + 0.5)
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corner
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if abs(area) < 1e-9 or x.size == 0:
        return np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0)
    wb = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
    wc = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
    row, col = np.nonzero((wb >= 0.0) & (wc >= 0.0) & (wb + wc <= 1.0))
    z = az + wb[row, col] * (bz - az) + wc[row, col] * (cz - az)
    return row + low[1], col + low[0], z
