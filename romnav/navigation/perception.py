"""From poses to LiDAR tokens: scan, corruption and frozen encoder, computed once per step."""

from __future__ import annotations

import torch
from torch import Tensor

from romnav.sensing.corruption import Corruption
from romnav.sensing.encoder import Encoder
from romnav.sensing.lidar import Lidar


class LidarPerception:
    """What the LiDAR sees from robots standing at given poses: tokens of a frozen encoder, or images.

    While the encoder is frozen, rollouts keep tokens in bfloat16, never images: they are all that learning needs.
    """

    def __init__(self, lidar: Lidar, corruption: Corruption, encoder: Encoder) -> None:
        self.lidar = lidar
        self.corruption = corruption
        self.encoder = encoder
        self.images = False
        """Whether to yield images, for a policy that has an encoder of its own."""
        self._mount = torch.tensor([0.0, 0.0, lidar.spec.height], device=encoder.directions.device)

    def __call__(self, tile: Tensor, position: Tensor, yaw: Tensor, counters: Tensor) -> Tensor:
        """(E, K, C) bfloat16 tokens, or (E, rows, columns) float16 images in m, 8 mm exact at 16 m.

        Args:
            tile: (E,) int.
            position: (E, 3) on the walking surface, tile frame, m.
            yaw: (E,) rad.
            counters: (E, 2) environment and step, which name the random numbers of the corruption.
        """
        ranges = self.lidar.scan(tile.to(torch.int32), position + self._mount, yaw)
        ranges = self.corruption(ranges, counters[:, 0], counters[:, 1])
        return ranges.half() if self.images else self.encoder.tokens(ranges).to(torch.bfloat16)
