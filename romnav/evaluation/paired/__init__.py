"""Paired episodes: every arm walks the same ones (paper, Sec. IV-A)."""
