"""Paired episodes, metrics and statistics."""
