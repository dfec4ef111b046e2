"""A body: the reduced-order model without sidesteps."""

from __future__ import annotations

import torch
from torch import Tensor

from romnav.robot.rom import ReducedOrderModel


class Unicycle(ReducedOrderModel):
    """Drives ahead, back and turns; what a command asks of it sideways is lost."""

    def step(self, command: Tensor) -> None:
        """Integrate the command (E, 3) for one period."""
        super().step(command * torch.tensor([1.0, 0.0, 1.0], device=command.device))
