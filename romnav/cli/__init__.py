"""The command line: parses, calls, prints; a module for each verb. Heavy imports wait until a command needs them."""

from romnav.cli import bench, describe, evaluate, export, play, project, report, run, train, view, watch
from romnav.cli.app import app, main

__all__ = [
    "app",
    "bench",
    "describe",
    "evaluate",
    "export",
    "main",
    "play",
    "project",
    "report",
    "run",
    "train",
    "view",
    "watch",
]
