"""What is committed under results/ is what its records tell of."""

from __future__ import annotations

import json
from pathlib import Path

from romnav.files import digest

RESULTS = Path(__file__).parents[1] / "results"


def recorded() -> dict[Path, str]:
    """Digest of every output of a record, by its place: beside the record, or in the folder above."""
    found = {}
    for record in RESULTS.rglob("*.json"):
        content = json.loads(record.read_text("utf-8"))
        for name, expected in (content.get("outputs") or {}).items() if isinstance(content, dict) else ():
            folder = record.parent.parent if "/" in name else record.parent
            found[folder / name] = expected
    return found


def test_committed_outputs_are_the_recorded_ones() -> None:
    outputs = {path: expected for path, expected in recorded().items() if path.exists()}
    assert len(outputs) > 300
    assert [str(path) for path, expected in outputs.items() if digest(path) != expected] == []
