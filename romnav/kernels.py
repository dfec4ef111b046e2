"""Warp, started once and quietly: import ``wp`` from here."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import torch
import warp as wp

__all__ = ["over_threads", "wp"]


def _start() -> None:
    wp.config.log_level = wp.LOG_WARNING
    # without a GPU, Warp's native code warns on standard error at every start, whatever the log level
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def over_threads(launch: Callable[[slice], None], count: int, device: str) -> None:
    """Call ``launch`` for slices of ``range(count)``, one for each of PyTorch's threads; for all at once on a GPU.

    A launch on the CPU runs on one thread, but releases the interpreter's lock.
    """
    threads = torch.get_num_threads() if device == "cpu" else 1
    parts = [slice(a, b) for a, b in pairwise(count * k // threads for k in range(threads + 1))]
    if threads == 1:
        launch(parts[0])
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(launch, parts))


_start()
