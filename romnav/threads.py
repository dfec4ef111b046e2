"""Threads and cores: how many PyTorch takes, and how many there are."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run PyTorch's CPU operators on ``count`` threads; another number gives other bits, since sums are split by it."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def cores() -> int:
    """Cores that this process may use: not all of the machine's under ``taskset`` or in a container with a quota."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(allowed, *(int(quota) for quota in _quotas())))


def _quotas() -> Iterator[float]:
    """Cores of processor time that each control group above this process allows (Linux, cgroup v2 and v1)."""
    yield float(os.cpu_count() or 1)
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0":
            own, read = CGROUPS / path.lstrip("/"), _of_v2
        elif "cpu" in controllers.split(","):
            own, read = CGROUPS / "cpu" / path.lstrip("/"), _of_v1
        else:
            continue
        # in a container the path may be that of the host: its own group then is the root
        for group in (own, *own.parents):
            if group.is_relative_to(CGROUPS) and (quota := read(group)):
                yield quota


def _of_v2(group: Path) -> float | None:
    try:
        quota, period = (group / "cpu.max").read_text().split()
    except (OSError, ValueError):
        return None
    return None if quota == "max" else int(quota) / int(period)


def _of_v1(group: Path) -> float | None:
    try:
        quota, period = (int((group / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
    except (OSError, ValueError):
        return None
    return quota / period if quota > 0 else None
