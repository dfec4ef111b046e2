"""Kills, damaged files and random worlds: what romnav survives, counted over as many runs of this as one likes.

Every call goes on where the last one ended, and adds to the counts of ``results/bench/faults.json``; `--kills 0` leaves
a part out.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import _damage
import _guarantee
import _kills
import _warp
from _common import CORES, arguments, markdown

from romnav import files
from romnav.experiment.graph import records

NAME = "faults"


def main() -> None:
    given = arguments(__doc__, kills=100, damages=100, worlds=100_000, warp=20)
    file = given.out / f"{NAME}.json"
    counts: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    with tempfile.TemporaryDirectory(prefix="romnav-faults-") as place:
        for kind in _damage.FILES:
            _add(file, counts, "damages", kind, given.damages, Path(place) / "damage")
        for k, kind in enumerate(_kills.TRAININGS):  # those that are left when all have had as many go to the last
            _add(file, counts, "kills", kind, (given.kills + k) // len(_kills.TRAININGS), Path(place) / kind)
        _add(file, counts, "warp", "eight processes and an empty cache", given.warp, Path(place) / "warp")
    _drive(file, counts, given.worlds)
    text = table(counts)
    files.write(given.out / f"{NAME}.md", text)
    print(text)


def _add(file: Path, counts: dict[str, Any], part: str, kind: str, trials: int, folder: Path) -> None:
    """Adds up to ``trials`` trials to the counts of a kind, numbered from the first that was not made yet."""
    before = counts.setdefault(part, {}).setdefault(kind, {})
    done = sum(before.values())
    if trials <= 0:
        return
    make = {"damages": _damage.damage, "kills": _kills.kill, "warp": _warp.race}[part]
    counts[part][kind] = dict(Counter(before) + make(kind, range(done, done + trials), folder))
    print(f"{part}, {kind}: {counts[part][kind]}", flush=True)
    _save(file, counts)


def _drive(file: Path, counts: dict[str, Any], worlds: int) -> None:
    """The filter's guarantee in further worlds."""
    so_far = counts.setdefault("guarantee", {"worlds": 0, "collided batches": 0, "closest": None, "way": 0.0})
    for _ in range(worlds // _guarantee.WORLDS):
        closest, way = _guarantee.batch(so_far["worlds"] // _guarantee.WORLDS, CORES)
        so_far["worlds"] += _guarantee.WORLDS
        so_far["collided batches"] += closest < 0.0
        so_far["closest"] = closest if so_far["closest"] is None else min(closest, so_far["closest"])
        so_far["way"] += way * _guarantee.WORLDS
        _save(file, counts)


def _save(file: Path, counts: dict[str, Any]) -> None:
    source = records.provenance()
    counts |= {"machine": source["machine"], "commit": source["commit"], "load": os.getloadavg()[1]}
    files.write(file, json.dumps(counts, indent=2) + "\n")


def _told(kind: str) -> str:
    return f"{kind} (by hand)" if _damage.FILES[kind].by_hand else kind


def table(counts: dict[str, Any]) -> str:
    """The counts as Markdown."""
    parts = []
    if any(counts.get("damages", {}).values()):
        rows = [
            [_told(kind), str(sum(found.values())), *(str(found.get(name, 0)) for name in _damage.OUTCOMES)]
            for kind, found in counts["damages"].items()
            if found
        ]
        parts.append(markdown(["file", "damaged", *_damage.OUTCOMES], rows))
    for part, good, head in (("kills", "same bits", "killed and resumed"), ("warp", "same bits", "race")):
        if any(counts.get(part, {}).values()):
            rows = [
                [kind, str(sum(found.values())), str(found.get(good, 0)), str(sum(found.values()) - found.get(good, 0))]
                for kind, found in counts[part].items()
                if found
            ]
            parts.append(markdown([head, "times", good, "lost"], rows))
    if (drive := counts.get("guarantee")) and drive["worlds"]:
        parts.append(
            f"The safety filter in {drive['worlds']:,} random worlds: {drive['way'] / 1000:.1f} km, "
            f"{drive['collided batches']} batches of {_guarantee.WORLDS} with a collision, least clearance "
            f"{1000 * drive['closest']:.0f} mm.\n"
        )
    return "\n".join(parts)


if __name__ == "__main__":
    main()
