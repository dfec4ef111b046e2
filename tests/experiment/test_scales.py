"""Whatever a scale says is refused by its key, or means something."""

from __future__ import annotations

import json
import math
import time
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.errors import RomnavError
from romnav.experiment.scales import Scale
from romnav.experiment.spec import parse
from tests.fuzz import FILE, leaves, nested


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("navigation.env.envs", 0),
        ("navigation.env.envs", 2**40),
        ("navigation.env.period", 0.0),
        ("navigation.env.period", -0.2),
        ("navigation.env.period", 5.0),
        ("navigation.env.max_goal_distance", 1.0),
        ("navigation.env.max_goal_distance", 0.5),
        ("navigation.env.duration", 0.0),
        ("navigation.env.duration", math.nan),
        ("navigation.env.command.forward", -1.0),
        ("navigation.env.reward.collision", 1.0),
        ("navigation.env.reward.position", math.inf),
        ("navigation.policy.attention", 30),
        ("navigation.policy.heads", 0),
        ("navigation.policy.recurrent", 0),
        ("navigation.policy.critic", []),
        ("navigation.policy.critic", [0]),
        ("navigation.ppo.gamma", 2.0),
        ("navigation.ppo.gamma", math.nan),
        ("navigation.ppo.learning_rate", 10.0),
        ("navigation.ppo.learning_rate_range", [1e-2, 1e-4]),
        ("navigation.ppo.iterations", 0),
        ("navigation.ppo.steps", -1),
        ("navigation.ppo.epochs", 0),
        ("navigation.ppo.minibatches", 0),
        ("navigation.ppo.minibatches", 1000),
        ("navigation.ppo.threads", 0),
        ("navigation.corruption.dropout", [0.5, 0.1]),
        ("navigation.corruption.dropout", [0.0, 1.1]),
        ("lidar.elevation", [4.0, -55.0]),
        ("lidar.elevation", [math.nan, 4.0]),
        ("lidar.min_range", 40.0),
        ("lidar.min_range", 0.0),
        ("depth.field", [0.0, 54.0]),
        ("pretrain.encoder.latent", 0),
        ("pretrain.encoder.widths", []),
        ("pretrain.encoder.strides", [[0, 2]]),
        ("pretrain.encoder.strides", [[2, 2]]),
        ("pretrain.encoder.strides", [[16, 16], [16, 2], [1, 1], [1, 1]]),
        ("pretrain_depth.encoder.strides", [[2, 16], [2, 4], [2, 1]]),
        ("pretrain.batch", 3_000_000),
        ("quality.images", 1),
        ("locomotion.iterations", 0),
        ("locomotion.robot.timestep", -0.01),
        ("locomotion.robot.weld_arms", False),
        ("locomotion.task.shares", {"stairs": 1.0}),
        ("locomotion.task.shares", {"flat": 0.5, "cliff": 0.5}),
        ("locomotion.ppo.std", [1.0, 0.5, 0.2]),
        ("locomotion.tiles.drivers", {"oracle": 1.0}),
        ("evaluation.episodes", "../secret"),
        ("evaluation.duration", -1.0),
        ("evaluation.duration", 121.0),
        ("safety.filter.occupancy.radius", 0.01),
        ("safety.filter.occupancy.size", 1.0),
        ("deploy.reach", 0.0),
    ],
)
def test_a_bad_setting_is_refused_by_its_key(key: str, value: Any) -> None:
    with pytest.raises(RomnavError) as refused:
        parse(Scale, nested(key, value), FILE)
    message = str(refused.value)
    assert message.startswith("mine.toml: ")
    assert key in message.replace(": ", ".", 2) or key in message
    assert "\n" not in message


@pytest.mark.parametrize("period", [0.19, 0.2, 0.21, 0.3, 0.01])
def test_a_humanoid_is_commanded_at_its_control_steps(period: float) -> None:
    """Known before a teacher is trained; other bodies take any period."""
    commanded = {"navigation": {"env": {"period": period}}}
    parse(Scale, commanded, FILE)
    walking = {"navigation": {**commanded["navigation"], "dynamics": "g1"}}
    if period in (0.2, 0.3):
        parse(Scale, walking, FILE)
        return
    with pytest.raises(
        RomnavError, match=rf"^mine\.toml: navigation\.env\.period: {period} s, no multiple of .*0\.02 s"
    ):
        parse(Scale, walking, FILE)
    parse(Scale, {**walking, "locomotion": {"robot": {"decimation": 1}}}, FILE)  # of 10 ms


SETTINGS = dict(leaves(Scale()))
ODD = [math.nan, math.inf, -math.inf, -1, 0, -0.5, 0.5, 2.0, 1e-30, 1e30, 1e308, 2**31, 2**63, 10**40, -(2**63)]


def values(default: Any) -> st.SearchStrategy[Any]:
    """Of the type of a default, or nearly."""
    if isinstance(default, tuple):
        return st.lists(values(default[0]) if default else st.just(0), max_size=5)
    if isinstance(default, dict):
        return st.dictionaries(st.sampled_from([*default, "other"]), st.sampled_from(ODD), max_size=4)
    if isinstance(default, bool):
        return st.sampled_from([True, False, 0, "true"])
    if isinstance(default, str):
        return st.sampled_from(["", "..", "a/b", "x" * 300, default, "\x00"])
    numbers = st.one_of(st.sampled_from(ODD), st.floats(), st.integers(-5, 5))
    return numbers if default is None else st.one_of(numbers, st.just(default))


@settings(deadline=None, max_examples=300)
@given(data=st.data())
def test_any_value_of_any_setting_is_taken_or_refused_in_one_line(data: st.DataObject) -> None:
    key = data.draw(st.sampled_from(sorted(SETTINGS)))
    value = data.draw(values(SETTINGS[key]))
    begun = time.monotonic()
    try:
        taken = parse(Scale, nested(key, value), FILE)
    except RomnavError as refused:
        message = str(refused)
    else:
        # what is taken is finite and comes back from a record as it is
        assert Scale.model_validate_json(json.dumps(taken.model_dump(mode="json"), allow_nan=False)) == taken
        message = f"mine.toml: {key}"
    assert message.startswith("mine.toml: ")
    assert key.split(".")[-1] in message
    assert "\n" not in message
    assert time.monotonic() - begun < 5.0


def test_every_number_has_a_range() -> None:
    """No setting takes a number of any size, or one that is not a number."""
    for key, default in SETTINGS.items():
        if isinstance(default, bool | str | dict | type(None)):
            continue
        for odd in (10**40, -(10**40)) if isinstance(default, int) else (1e300, -1e300, math.nan):
            value = [odd] * len(default) if isinstance(default, tuple) else odd
            with pytest.raises(RomnavError, match=key.split(".")[-1]):
                parse(Scale, nested(key, value), FILE)
