"""Stages as shell commands, for a cluster's own queue."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from romnav.experiment.graph.stage import Stage


def shell(stages: Sequence[Stage], last: Sequence[str], options: Sequence[str] = ()) -> list[str]:
    """One line for each stage that has a command of its own, then ``last``, which makes what has none.

    Args:
        stages: What is to run, upstream ones first.
        last: Words after ``romnav`` of the command that asked for them.
        options: What every stage's command is given in addition.

    Returns:
        Shell commands. The comment behind each says which line it is and which lines have to end before it begins.
    """
    number: dict[str, int] = {}
    lines = []
    for stage in stages:
        if stage.command:
            number[stage.name] = len(number) + 1
            before = sorted(number[above.name] for above in stage.upstream if above.name in number)
            lines.append(_line((*stage.command, *options), number[stage.name], before))
    return [*lines, _line(last, len(number) + 1, list(number.values()))]


def _line(words: Sequence[str], number: int, before: Sequence[int]) -> str:
    after = f" after {','.join(map(str, before))}" if before else ""
    return f"{shlex.join(('romnav', *words))} # {number}{after}"
