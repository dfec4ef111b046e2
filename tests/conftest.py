"""Shared fixtures."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest

from romnav.evaluation.paired import rows
from romnav.evaluation.trials import rows as trial_rows
from romnav.world.spec import SMALLEST


@pytest.fixture(scope="session", autouse=True)
def _signals_are_heard() -> Iterator[None]:
    """Under nohup, or in the background of a script, tests would ignore signals that some of them send."""
    heard = {signal.SIGHUP: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in heard.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def _episode_rows(
    arm: str = "rom", skill: float = 0.7, seed: int = 0, n: int = 64, draw: int = 0, **provenance: object
) -> rows.EpisodeRows:
    """Rows of an arm that solves an episode with probability `skill`, less across levels."""
    episode = np.random.default_rng(n)  # the episodes depend on their number alone, as in a paired set
    luck = np.random.default_rng([draw, seed, *arm.encode()])
    level = np.where(episode.random(n) < 0.5, "same", "cross")
    geodesic = episode.uniform(1, 30, n)
    poses = {name: episode.normal(size=n) for name in rows.SCHEMA.names if name.startswith(("spawn", "goal"))}
    solved = luck.random(n) < skill * np.where(level == "cross", 0.6, 1.0)
    time = np.minimum(geodesic * luck.uniform(1, 5, n), 120.0)
    outcome = np.where(solved, "success", np.where(luck.random(n) < 0.5, "fall", "timeout"))
    columns = {
        "arm": np.full(n, arm),
        "seed": np.full(n, seed),
        "episode": np.arange(n),
        "tile": np.arange(n) // 8,
        "tile_class": np.array(list(SMALLEST))[np.arange(n) % 3],
        "multi_story": np.arange(n) % 3 == 2,
        **poses,
        "geodesic": geodesic,
        "level": level,
        "success_time": np.where(solved, time, np.nan),
        "outcome": outcome,
        "time": np.where(outcome == "timeout", 120.0, time),
        "path_length": geodesic * luck.uniform(0.9, 2.0, n),
        "final_distance": np.where(solved, 0.3, geodesic * luck.uniform(0, 2, n)),
        "collisions": luck.poisson(1.0, n),
    }
    places = np.where(level == "same", rows.WHERE[0], luck.choice(rows.WHERE[1:], n))
    columns["where"] = np.where(solved, "", places)
    columns["how"] = np.where(solved, "", np.where(outcome == "fall", rows.HOW[0], luck.choice(rows.HOW[1:], n)))
    made = {
        "scale": "smoke",
        "commit": "0123456789abcdef",
        "spec_hash": "spec",
        "checkpoint_sha256": "f00d",
        "episode_set": "feedc0ffee123456",
        "version": "0.1.0",
        "steps": 1_500_000,
        "hours": 0.2,
        "machine": "2 cores",
    }
    return rows.make(columns, rows.Provenance(**{**made, **provenance}), source=f"{arm}/seed-{seed}")


def _trial_run(
    arm: str = "rom",
    skill: float = 0.7,
    seed: int = 0,
    n: int = 32,
    scenes: Sequence[str] = ("in-distribution", "out-of-distribution", "adversarial"),
) -> trial_rows.TrialRows:
    """Trials of an arm that arrives with probability `skill`; the filter halves that and prevents most collisions."""
    luck = np.random.default_rng([seed, n, *arm.encode()])
    parts = []
    for filtered in (False, True):
        for scene in scenes:
            start, goal = luck.uniform(20, 40, (2, n, 2))
            success = luck.random(n) < skill * (0.5 if filtered else 1.0)
            steps = luck.integers(20, 60, n)
            hits = [np.array([5], np.int16)[: int(luck.random() < (0.05 if filtered else 0.5))] for _ in range(n)]
            ways = [np.linspace(a, b, k + 1) for a, b, k in zip(start, goal, steps, strict=True)]
            tracks = [np.round(100 * np.column_stack([w, np.zeros(len(w))])).astype(np.int16).ravel() for w in ways]
            distance = np.linalg.norm(goal - start, axis=1)
            parts.append(
                {
                    "scene": np.full(n, scene, object),
                    "filter": np.full(n, filtered),
                    "trial": np.arange(n),
                    **{f"spawn_{axis}": start[:, k] for k, axis in enumerate("xy")},
                    **{f"goal_{axis}": goal[:, k] for k, axis in enumerate("xy")},
                    **{name: np.zeros(n) for name in ("spawn_z", "spawn_yaw", "goal_z", "goal_yaw")},
                    "geodesic": distance,
                    "success_time": np.where(success, 0.2 * steps, np.nan),
                    "outcome": np.where(success, "success", "timeout").astype(object),
                    "time": 0.2 * steps,
                    "path_length": distance,
                    "final_distance": np.where(success, 0.4, distance),
                    "collisions": np.array([len(h) for h in hits]),
                    "contact_time": np.array([0.2 * len(h) for h in hits]),
                    **{name: np.zeros(n) for name in ("brink_time", "acting_time", "held_time")},
                    "blocked": ~success & filtered,
                    "hits": _objects(hits),
                    "track": _objects(tracks),
                }
            )
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    provenance = _episode_rows(arm, seed=seed, steps=0 if arm in ("oracle", "straight") else 1_500_000).provenance
    return trial_rows.TrialRows(arm, seed, columns, provenance)


def _objects(values: list) -> np.ndarray:
    out = np.empty(len(values), object)
    out[:] = values
    return out


@pytest.fixture(scope="session")
def trial_run() -> Callable[..., trial_rows.TrialRows]:
    """Factory of synthetic trials in scenes."""
    return _trial_run


@pytest.fixture(scope="session")
def episode_rows() -> Callable[..., rows.EpisodeRows]:
    """Factory of synthetic episode rows."""
    return _episode_rows
