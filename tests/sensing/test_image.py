"""Points fall into the pixels whose rays they lie on."""

from __future__ import annotations

import math

import pytest
import torch

from romnav.sensing.image import directions, level, project
from romnav.sensing.spec import LidarSpec

SPEC = LidarSpec(rows=15, columns=55)


def test_points_on_the_rays_give_back_the_image() -> None:
    ranges = torch.rand(15, 55, generator=torch.Generator().manual_seed(0)) * 20.0 + 0.2
    ranges[3, 7] = 0.0
    points = (ranges[..., None] * directions(SPEC))[ranges > 0]
    shuffled = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(1))]
    torch.testing.assert_close(project(shuffled, SPEC), ranges)


def test_the_nearest_return_of_a_pixel_counts_and_others_do_not() -> None:
    ray = directions(SPEC)[4, 20]
    behind, beside = torch.tensor([-3.0, 0.0, -1.0]), torch.tensor([3.0, 0.0, 3.0])
    cloud = torch.stack([5.0 * ray, 2.0 * ray, 0.01 * ray, 99.0 * ray, behind, beside, torch.full((3,), torch.nan)])
    image = project(cloud, SPEC)
    assert image[4, 20].item() == pytest.approx(2.0)
    assert (image > 0).sum() == 1


def test_no_points_are_no_returns() -> None:
    assert not project(torch.empty(0, 3), SPEC).any()


def test_level_undoes_the_tilt_of_the_torso() -> None:
    """A point straight ahead of a torso that leans forward is below the horizon; one at its left, if it rolls."""
    ahead, left = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    pitched, rolled = level(ahead, 0.0, 0.3), level(left, 0.2, 0.0)
    torch.testing.assert_close(pitched, torch.tensor([[math.cos(0.3), 0.0, -math.sin(0.3)]]))
    torch.testing.assert_close(rolled, torch.tensor([[0.0, math.cos(0.2), math.sin(0.2)]]))
