"""Terrain: solids, tiles, and everything that is derived from them."""
