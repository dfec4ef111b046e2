"""Warp, started once and quietly: import ``wp`` from here."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import torch
import warp as wp

from romnav.errors import RomnavError

__all__ = ["over_threads", "wp"]

ROOM = 16_000_000
"""Bytes for kernels that are yet to be compiled; all thirty modules take 2.4 MB."""


def _start() -> None:
    """Start Warp.

    Raises:
        RomnavError: its cache has no folder, or no room: there, LLVM ends the process without a word of where.
    """
    wp.config.log_level = wp.LOG_WARNING
    # without a GPU, Warp's native code warns on standard error at every start, whatever the log level
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()
    except OSError as error:
        raise RomnavError(
            f"{error.filename}: Warp's kernels cannot be kept there ({(error.strerror or str(error)).lower()}); set "
            "WARP_CACHE_PATH to a folder that can be written"
        ) from error
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    cache = wp.config.kernel_cache_dir
    if (free := shutil.disk_usage(cache).free) < ROOM:
        raise RomnavError(
            f"{cache}: its disk has {free / 1e6:.1f} MB left, too few for Warp's kernels; free some, or set "
            "WARP_CACHE_PATH to a folder on another disk"
        )


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
