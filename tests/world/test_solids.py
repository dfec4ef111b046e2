from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.world.solids import Label, SolidsBuilder

angle = st.floats(-7.0, 7.0)
coordinate = st.floats(-20.0, 20.0)


@settings(deadline=None)
@given(angle, coordinate, coordinate, st.floats(0.1, 5.0), st.floats(0.1, 5.0))
def test_corners_are_the_local_half_extents_turned_counter_clockwise(
    yaw: float, x: float, y: float, length: float, width: float
) -> None:
    builder = SolidsBuilder()
    builder.box((x, y), (length, width), (0.0, 1.0), yaw=yaw)
    solids = builder.build()
    (corners,) = solids.corners()
    u, v = solids.local(corners)
    np.testing.assert_allclose(np.abs(u[0]), length / 2, rtol=1e-9)
    np.testing.assert_allclose(np.abs(v[0]), width / 2, rtol=1e-9)
    after = np.roll(corners, -1, axis=0)
    area = (corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]).sum() / 2
    np.testing.assert_allclose(area, length * width, rtol=1e-6)


@settings(deadline=None)
@given(coordinate, coordinate, coordinate, coordinate, st.floats(-2.0, 2.0))
def test_a_segment_runs_from_start_to_end_and_rises(x0: float, y0: float, x1: float, y1: float, rise: float) -> None:
    if np.hypot(x1 - x0, y1 - y0) < 1e-2:
        return
    builder = SolidsBuilder()
    builder.segment((x0, y0), (x1, y1), 0.1, (0.9, 1.0), rise=rise)
    solids = builder.build()
    u, v = solids.local(np.array([[x0, y0], [x1, y1]]))
    np.testing.assert_allclose(u[0], [-solids.half[0, 0], solids.half[0, 0]], atol=1e-9)
    np.testing.assert_allclose(v[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(solids.top + solids.slope_top * u[0], [1.0, 1.0 + rise], atol=1e-9)
    np.testing.assert_allclose(solids.bottom + solids.slope_bottom * u[0], [0.9, 0.9 + rise], atol=1e-9)


def test_indexing_keeps_rows_together() -> None:
    builder = SolidsBuilder()
    builder.box((0.0, 0.0), (1.0, 2.0), (0.0, 1.0), label=Label.GROUND, layers=(0, 0))
    builder.cylinder((3.0, 4.0), 0.5, (0.0, 2.0))
    solids = builder.build()
    assert solids.walkable.tolist() == [True, False]
    pole = solids[~solids.walkable]
    assert len(pole) == 1
    assert pole.centre.tolist() == [[3.0, 4.0]]
    assert pole.label.tolist() == [Label.OBSTACLE]


def test_degenerate_solids_are_refused() -> None:
    builder = SolidsBuilder()
    with pytest.raises(ValueError, match="degenerate box"):
        builder.box((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    with pytest.raises(ValueError, match="degenerate box"):
        builder.box((0.0, 0.0), (1.0, 1.0), (1.0, 1.0))
    with pytest.raises(ValueError, match="degenerate cylinder"):
        builder.cylinder((0.0, 0.0), -0.1, (0.0, 1.0))
