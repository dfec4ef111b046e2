"""Processes that compute one thing together, as torchrun starts them (``torch.distributed``; rank 0 leads).

In a process on its own every function is the identity, and PyTorch is not imported before it is needed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from romnav.errors import RomnavError

if TYPE_CHECKING:
    from torch import Tensor

PATIENCE = timedelta(days=7)
"""What a process waits for the others: rank 0 may have to wait for a lock. One that ends is noticed at once."""


def started() -> int:
    """Processes that torchrun has started for this command; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextmanager
def joined(device: str) -> Iterator[str]:
    """Within it, all processes of this command are one group; yields the device of this one.

    What ends them all is told by rank 0.

    Raises:
        RomnavError: They cannot meet; another one has ended; devices are given that they would share.
    """
    if started() == 1:
        yield device
        return
    import tensordict  # noqa: F401  # before the group: its functions keep the one that is there, and so gloo's threads
    import torch
    from torch import distributed

    if device not in ("cpu", "cuda"):
        raise RomnavError(f"--device {device}: several processes have one each; give cpu or cuda")
    if device == "cuda":
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
        torch.cuda.set_device(device)
    try:
        distributed.init_process_group("gloo" if device == "cpu" else "cpu:gloo,cuda:nccl", timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise RomnavError(f"{started()} processes (WORLD_SIZE): {reason}; start them by torchrun") from error
    leads = rank() == 0
    try:
        yield device
        if leads:
            call(None)
    except RuntimeError as error:
        if not isinstance(error, distributed.DistError) and "gloo" not in str(error):
            raise
        if not leads:
            raise SystemExit(1) from error
        raise RomnavError("another process of this run has ended; its message, or the system's, tells why") from error
    except KeyboardInterrupt:
        if not leads:
            raise SystemExit(1) from None
        raise
    finally:
        distributed.destroy_process_group()


def size() -> int:
    """Processes of the group."""
    return started() if _is_joined() else 1


def rank() -> int:
    """Number of this process among them."""
    return int(os.environ["RANK"]) if _is_joined() else 0


def _is_joined() -> bool:
    if started() == 1:
        return False
    from torch import distributed

    return distributed.is_initialized()


def share(count: int) -> range:
    """Of ``count`` numbered things, those of this process; ``count`` is a multiple of the `size`."""
    each = count // size()
    return range(rank() * each, (rank() + 1) * each)


def total(values: Tensor) -> Tensor:
    """Sum of the tensors of all processes."""
    if size() == 1:
        return values
    from torch import distributed

    values = values.clone()
    distributed.all_reduce(values)
    return values


def means(values: dict[str, float]) -> dict[str, float]:
    """Means over the processes of numbers with the same names."""
    if size() == 1:
        return values
    import torch

    of_all = total(torch.tensor(list(values.values()), dtype=torch.float64)) / size()
    return dict(zip(values, of_all.tolist(), strict=True))


def anywhere(*flags: bool) -> list[bool]:
    """Which of the flags are set in any process."""
    if size() == 1:
        return list(flags)
    import torch

    return [bool(count) for count in total(torch.tensor(flags, dtype=torch.int32)).tolist()]


def gathered(item: Any) -> list[Any]:
    """At rank 0 the item of every process, elsewhere nothing."""
    if size() == 1:
        return [item]
    from torch import distributed

    items: list[Any] | None = [None] * size() if rank() == 0 else None
    distributed.gather_object(item, items)
    return items or []


def call(name: str | None) -> None:
    """At rank 0: has the others `hear` what to do next; None lets them go."""
    if size() > 1:
        hear(name)


def hear(name: str | None = None) -> str | None:
    """What rank 0 calls."""
    from torch import distributed

    heard = [name]
    distributed.broadcast_object_list(heard)
    return heard[0]
