"""The paper's results, as published, for printing beside ours. Arms are named as in ``results/``."""

from __future__ import annotations

PERFORMANCE: dict[str, dict[str, float]] = {
    "rom": {"sr_45": 84.1, "sr_120": 93.6, "t2g": 25.6, "spl": 0.776, "hours": 12.0},
    "single-stage": {
        **{"sr_45": 62.2, "sr_120": 81.7, "t2g": 32.1, "spl": 0.690},
        **{"sr_120_same": 94.2, "sr_120_cross": 68.3},
    },
    "rom-hum": {
        **{"sr_45": 74.2, "sr_120": 88.1, "t2g": 29.8, "spl": 0.713, "hours": 12.0},
        **{"falls_cross": 16.3, "timeouts_cross": 4.9, "sr_120_same": 96.6, "sr_120_cross": 78.8},
    },
    "rom-nav": {
        **{"sr_45": 82.3, "sr_120": 92.8, "t2g": 28.8, "spl": 0.769, "hours": 32.0},
        **{"falls_cross": 8.3, "timeouts_cross": 3.7, "sr_120_same": 97.2, "sr_120_cross": 88.0},
    },
    "uniform": {"sr_45": 70.9, "sr_120": 77.4, "t2g": 23.3, "spl": 0.640},
    "nocap": {"sr_45": 69.8, "sr_120": 75.8, "t2g": 22.9, "spl": 0.624},
    "uniform-nocap": {"sr_45": 65.7, "sr_120": 75.1, "t2g": 24.9, "spl": 0.601},
}
"""Tables nav-perf and spawngoal-perf-rom: success rates in percent, time to goal in s, SPL in 0..1; hours of training
on one H100 at 4096 environments (Sec. III-C); falls and timeouts on cross-level episodes of 120 s, percent (Sec. IV-A).
Success by level is derived: what neither falls nor times out across levels succeeds, the rest of the total is on one
level, and contrasts lead to the other arms.
"""

CONTRASTS: dict[tuple[str, str], dict[tuple[int, str], tuple[float, bool]]] = {
    ("rom-nav", "rom-hum"): {
        (45, "same"): (1.5, False),
        (45, "cross"): (15.2, True),
        (120, "same"): (0.6, False),
        (120, "cross"): (9.1, True),
    },
    ("rom-nav", "single-stage"): {
        (45, "same"): (6.8, True),
        (45, "cross"): (34.6, True),
        (120, "same"): (3.0, True),
        (120, "cross"): (19.7, True),
    },
    ("rom", "uniform"): {
        (45, "same"): (0.0, False),
        (45, "cross"): (27.8, True),
        (120, "same"): (0.6, False),
        (120, "cross"): (33.5, True),
    },
    ("rom", "nocap"): {
        (45, "same"): (-0.6, False),
        (45, "cross"): (30.7, True),
        (120, "same"): (-0.2, False),
        (120, "cross"): (37.7, True),
    },
    ("rom", "uniform-nocap"): {
        (45, "same"): (1.0, False),
        (45, "cross"): (37.7, True),
        (120, "same"): (0.0, False),
        (120, "cross"): (39.0, True),
    },
}
"""Tables nav-levels and spawngoal-levels-rom: (horizon in s, level) to the difference of success rates in
percent and whether its 95 % interval excludes zero."""

ITERATION_TIME: dict[str, float] = {"frozen": 1.0, "unfrozen": 1.15}
"""Duration of an iteration relative to one with a frozen encoder (Sec. IV-B, Pretrained Encoders)."""

SAFETY: dict[tuple[str, bool], dict[str, float]] = {
    ("in-distribution", False): {"successes": 10, "collisions": 0, "time": 5.9, "time_std": 1.5},
    ("in-distribution", True): {"successes": 10, "collisions": 0, "time": 6.7, "time_std": 2.1},
    ("out-of-distribution", False): {"successes": 10, "collisions": 2, "time": 7.5, "time_std": 1.7},
    ("out-of-distribution", True): {"successes": 10, "collisions": 0, "time": 11.0, "time_std": 5.8},
    ("adversarial", False): {"successes": 10, "collisions": 4, "time": 5.5, "time_std": 1.0},
    ("adversarial", True): {"successes": 10, "collisions": 0, "time": 6.9, "time_std": 1.7},
}
"""Table e4-hardware: (obstacles, filter on) to trials out of ten, and time to goal in s."""

DEPLOYMENTS = {"lab": 38.0, "stairwell": 51.0, "entrance": 51.0, "outdoors": 100.0}
"""Lengths of the four deployments, m (Sec. IV-D and its figure); none of them included a collision."""

TRAINING = {"environments": 4096, "rom_hours": 12.0, "rom_nav_hours": 32.0, "goal_mask_minutes": 14.0}
"""Cost of training on one H100 (Sec. III)."""
