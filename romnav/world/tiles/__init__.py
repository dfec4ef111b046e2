"""Procedural generators of the tile classes (paper, Sec. III-D, Environments)."""

from romnav.world.tiles.generate import fault, generate

__all__ = ["fault", "generate"]
