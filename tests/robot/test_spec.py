"""Whatever the settings of the humanoid say: refused by a key, or the first iteration of locomotion runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from romnav.robot.locomotion.train import train
from romnav.robot.spec import LocomotionSpec
from tests.fuzz import FILE, stop, try_settings

TINY = {
    "task": {"robots": 4, "shares": {"flat": 1.0}},
    "ppo": {"steps": 2, "epochs": 1, "minibatches": 1, "hidden": [8]},
    "tiles": {"world": {"tiles": 1, "side": 20.0, "goals_per_tile": 4}},
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@settings(deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_settings_are_refused_by_a_key_or_their_first_iteration_runs(tmp_path: Path, data: st.DataObject) -> None:
    def begin(spec: LocomotionSpec) -> None:
        train(spec, tmp_path, resume=False, progress=stop, threads=1)

    message = try_settings(LocomotionSpec, TINY, begin, data.draw)
    assert not message or message.startswith((f"{FILE}: ", str(tmp_path)))
    assert "\n" not in message
