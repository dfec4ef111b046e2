"""Whatever the settings say: refused by its key, or the first iteration runs."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from romnav.navigation.spec import NavigationSpec
from romnav.navigation.train import train
from romnav.world.world import World
from tests.fuzz import FILE, stop, try_settings

from .conftest import FakePerception

TINY = {
    "env": {"envs": 4, "duration": 4.0},
    "policy": {"attention": 8, "heads": 4, "queries": 2, "recurrent": 8, "hidden": 8, "critic": [8]},
    "ppo": {"steps": 3, "epochs": 1, "minibatches": 2},
}
WITHIN = 5.0
"""For an answer, s of processor time."""


@pytest.mark.filterwarnings("ignore")
@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_settings_are_refused_by_a_key_or_their_first_iteration_runs(
    world: World, tmp_path: Path, data: st.DataObject
) -> None:
    def begin(spec: NavigationSpec) -> None:
        train(spec, world, FakePerception(), tmp_path, 0, resume=False, progress=stop)

    begun = time.process_time()
    message = try_settings(NavigationSpec, TINY, begin, data.draw)
    assert not message or message.startswith((f"{FILE}: ", str(tmp_path)))
    assert "\n" not in message
    assert time.process_time() - begun < WITHIN
