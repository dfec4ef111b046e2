"""What the LiDAR and the depth camera have in common: one image of ranges for each environment's pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, overload

import torch
from torch import Tensor

from romnav.kernels import over_threads
from romnav.sensing.spec import DepthSpec, LidarSpec


class Sensor(ABC):
    """A sensor of every environment over a fixed set of tiles, one ray through the centre of each pixel."""

    spec: LidarSpec | DepthSpec
    device: str
    directions: Tensor
    """(rows, columns, 3) vectors that a pixel's range scales, x forward, y left, z up."""
    _label_type: ClassVar[torch.dtype] = torch.int8

    @overload
    def scan(
        self,
        tile: Tensor,
        origin: Tensor,
        yaw: Tensor,
        *,
        labels: Literal[False] = ...,
        tilt: Tensor | None = ...,
    ) -> Tensor: ...

    @overload
    def scan(
        self, tile: Tensor, origin: Tensor, yaw: Tensor, *, labels: Literal[True], tilt: Tensor | None = ...
    ) -> tuple[Tensor, Tensor]: ...

    def scan(
        self, tile: Tensor, origin: Tensor, yaw: Tensor, *, labels: bool = False, tilt: Tensor | None = None
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Measure the images, without noise.

        Args:
            tile: (E,) int32, tile of each environment.
            origin: (E, 3) float32, centre of the sensor in the tile frame, m.
            yaw: (E,) float32, heading of the torso, rad.
            labels: Whether to return the `romnav.world.solids.Label` of each return as well.
            tilt: (E, 2) float32, roll and pitch of the torso that carries the sensor, rad; None if upright.

        Returns:
            (E, rows, columns) float32 in m, 0 where there is no return; with ``labels`` also
            (E, rows, columns) int8, -1 where there is no return.
        """
        count = len(tile)
        ranges = torch.empty(count, self.spec.rows, self.spec.columns, device=self.device)
        classes = torch.full_like(ranges, -1, dtype=self._label_type) if labels else None
        if tilt is None:
            tilt = torch.zeros(count, 2, device=self.device)
        pose = tile.int().contiguous(), origin.float().contiguous(), *self._orientation(yaw.float(), tilt.float())

        def launch(part: slice) -> None:
            self._launch([x[part] for x in pose], ranges[part], None if classes is None else classes[part])

        over_threads(launch, count, self.device)
        return ranges if classes is None else (ranges, classes.to(torch.int8))

    @abstractmethod
    def _orientation(self, yaw: Tensor, tilt: Tensor) -> tuple[Tensor, ...]:
        """What the kernel takes for a heading (E,) and a tilt (E, 2): contiguous tensors (E, ...)."""

    @abstractmethod
    def _launch(self, pose: list[Tensor], ranges: Tensor, labels: Tensor | None) -> None:
        """Fill ``ranges`` and ``labels`` of a few environments: tile, origin and what `_orientation` made."""
