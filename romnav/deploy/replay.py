"""Recorded sensor streams, and what a policy makes of them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from romnav import files
from romnav.deploy.runner import Runner, Sensed
from romnav.errors import RomnavError
from romnav.progress import Progress
from romnav.safety.barrier import Status


@dataclass(frozen=True)
class Stream:
    """What a robot knew over ``T`` control periods: the fields of `Sensed`, one row each."""

    position: NDArray[np.float32]
    """(T, 3)."""
    yaw: NDArray[np.float32]
    """(T,)."""
    goal: NDArray[np.float32]
    """(T, 3)."""
    goal_yaw: NDArray[np.float32]
    """(T,)."""
    tilt: NDArray[np.float32]
    """(T, 2)."""
    proprioception: NDArray[np.float32]
    """(T, P)."""
    returns: NDArray[np.int64] | None = None
    """(T,) number of points of each period, in a stream of points."""
    points: NDArray[np.float32] | None = None
    """(returns in all, 3)."""
    ranges: NDArray[np.float32] | None = None
    """(T, rows, columns), in a stream of range images."""
    depth: NDArray[np.float32] | None = None
    """(T, rows, columns), of a robot with a camera."""

    @classmethod
    def of(cls, steps: Iterable[Sensed]) -> Stream:
        """The stream of what was sensed, period by period; all of it points, or all of it range images."""
        steps = list(steps)
        columns: dict[str, Any] = {
            field.name: np.array([getattr(step, field.name) for step in steps], np.float32)
            for field in fields(Sensed)
            if field.name != "points" and getattr(steps[0], field.name) is not None
        }
        if steps[0].points is None:
            return cls(**columns)
        clouds = [np.asarray(step.points, np.float32) for step in steps]
        return cls(**columns, returns=np.array([len(c) for c in clouds]), points=np.concatenate(clouds))

    def __len__(self) -> int:
        return len(self.yaw)

    def __iter__(self) -> Iterator[Sensed]:
        last = np.zeros(len(self), int) if self.returns is None else np.cumsum(self.returns)
        for t in range(len(self)):
            yield Sensed(
                position=self.position[t],
                yaw=float(self.yaw[t]),
                goal=self.goal[t],
                goal_yaw=float(self.goal_yaw[t]),
                points=None if self.points is None else self.points[last[t - 1] if t else 0 : last[t]],
                ranges=None if self.ranges is None else self.ranges[t],
                tilt=(float(self.tilt[t, 0]), float(self.tilt[t, 1])),
                depth=None if self.depth is None else self.depth[t],
                proprioception=self.proprioception[t],
            )

    def save(self, path: Path) -> None:
        """Write it to an .npz file.

        Raises:
            RomnavError: The file cannot be written.
        """
        arrays = {field.name: value for field in fields(self) if (value := getattr(self, field.name)) is not None}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        files.write(path, buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> Stream:
        """Read it.

        Raises:
            RomnavError: The file is missing or no stream.
        """
        try:
            with np.load(path, allow_pickle=False) as content:
                return cls(**{name: content[name] for name in content.files})
        except FileNotFoundError:
            raise RomnavError(f"{path}: no such stream") from None
        except Exception as error:
            # a damaged file can make the reader fail in any way; without pickles it runs nothing on it
            raise RomnavError(f"{path}: truncated, or no stream of `romnav.deploy.replay.Stream.save`") from error


@dataclass(frozen=True)
class Replayed:
    """What a policy made of a stream."""

    command: NDArray[np.float32]
    """(T, 3) safe velocities, m/s and rad/s."""
    wanted: NDArray[np.float32]
    """(T, 3) before the filter."""
    status: NDArray[np.int64]
    """(T,) `Status`."""
    seconds: NDArray[np.float64]
    """(T,) time that each took."""

    def summary(self) -> dict[str, float]:
        """Latency in ms, and shares of the periods in percent in which the filter acted or stopped the robot."""
        milliseconds = 1e3 * self.seconds
        return {
            "periods": len(self.seconds),
            "median ms": float(np.median(milliseconds)),
            "99 % ms": float(np.quantile(milliseconds, 0.99)),
            "worst ms": float(milliseconds.max()),
            "filtered %": 100.0 * float((self.status != Status.UNCHANGED).mean()),
            "stopped %": 100.0 * float((self.status >= Status.BLOCKED).mean()),
        }


def replay(runner: Runner, stream: Stream, progress: Progress | None = None) -> Replayed:
    """Feed a stream to a runner from its beginning; what it commands moves nothing.

    Raises:
        RomnavError: The stream lacks what the policy needs.
    """
    runner.reset()
    done = []
    for sensed in stream:
        done.append(runner(sensed))
        if progress:
            progress(len(done), len(stream), "")
    return Replayed(
        command=np.array([v.command for v in done]),
        wanted=np.array([v.wanted for v in done]),
        status=np.array([int(v.status) for v in done]),
        seconds=np.array([v.seconds for v in done]),
    )
