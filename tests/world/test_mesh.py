from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.world.mesh import triangulate
from romnav.world.solids import Solids, SolidsBuilder

number = st.floats(-5.0, 5.0)
size = st.floats(0.05, 4.0)


@st.composite
def some_solids(draw: st.DrawFn) -> Solids:
    builder = SolidsBuilder()
    for _ in range(draw(st.integers(1, 4))):
        centre, z, thick = (draw(number), draw(number)), draw(number), draw(size)
        if draw(st.booleans()):
            length, width = draw(size), draw(size)
            limit = thick / length
            slope, slope_bottom = draw(st.floats(-limit, limit)), draw(st.floats(-0.9 * limit, 0.9 * limit))
            builder.box(
                centre,
                (length, width),
                (z, z + thick),
                yaw=draw(number),
                slope=slope,
                slope_bottom=slope_bottom,
            )
        else:
            builder.cylinder(centre, draw(size), (z, z + thick))
    return builder.build()


@settings(max_examples=60, deadline=None)
@given(some_solids(), st.integers(3, 40))
def test_every_solid_is_closed_and_bounds_its_volume_from_outside(solids: Solids, segments: int) -> None:
    mesh = triangulate(solids, segments)
    for s in range(len(solids)):
        faces = mesh.triangles[mesh.solid == s]
        edges = Counter((int(t[k]), int(t[(k + 1) % 3])) for t in faces for k in range(3))
        assert set(edges.values()) == {1}
        assert all((b, a) in edges for a, b in edges)
        a, b, c = mesh.vertices[faces].transpose(1, 0, 2) - mesh.vertices[faces[0, 0]]
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
        half = solids.half[s]
        area = 4 * half.prod() if solids.shape[s] == 0 else half[0] ** 2 * segments / 2 * np.sin(2 * np.pi / segments)
        np.testing.assert_allclose(volume, area * (solids.top[s] - solids.bottom[s]), rtol=1e-9)


@settings(max_examples=60, deadline=None)
@given(some_solids(), st.integers(0, 2**32 - 1))
def test_a_point_is_inside_a_solid_iff_a_ray_leaves_its_mesh_an_odd_number_of_times(
    vertical_hits: Callable, inside: Callable, solids: Solids, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    mesh = triangulate(solids, 720)
    around = rng.integers(len(solids), size=20)
    reach = np.column_stack([solids.half[around], solids.top[around] - solids.bottom[around]]) * 1.2
    points = np.column_stack([solids.centre[around], (solids.top + solids.bottom)[around] / 2])
    points = points + rng.uniform(-1, 1, (20, 3)) * reach
    sure = inside(solids, points, 1e-4) == inside(solids, points, -1e-4)
    for p, (hit, z) in enumerate(vertical_hits(mesh, points[:, :2])):
        leaves = np.bincount(mesh.solid[hit[z > points[p, 2]]], minlength=len(solids)) % 2 == 1
        np.testing.assert_array_equal(leaves[sure[:, p]], inside(solids, points, 0.0)[sure[:, p], p])
