"""Warp, started once and quietly: import ``wp`` from here."""

from __future__ import annotations

import os

import warp as wp

__all__ = ["wp"]


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


_start()
