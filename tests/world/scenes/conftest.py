"""The worlds of both sets of scenes, built once."""

from __future__ import annotations

import pytest

from romnav.world.scenes.deployments import deployment_scenes
from romnav.world.scenes.obstacles import obstacle_scenes
from romnav.world.scenes.scene import Scene, scene_world
from romnav.world.world import World

Set = tuple[tuple[Scene, ...], World]


@pytest.fixture(scope="session")
def obstacles() -> Set:
    """The obstacle sets."""
    scenes = obstacle_scenes()
    return scenes, scene_world(scenes)


@pytest.fixture(scope="session")
def deployments() -> Set:
    """The deployments."""
    scenes = deployment_scenes()
    return scenes, scene_world(scenes)
