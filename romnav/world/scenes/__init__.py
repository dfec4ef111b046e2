"""Scenes built by hand: the paper's obstacle sets and deployments, described by the same solids as tiles."""
