"""Writes numbers and tables of results/ into the Markdown that quotes them: `make numbers`.

A quoted number stands between two comments, of which the first tells where it comes from:

    <!-- = results/bench/lidar-paper.json ours .0f -->411<!-- -->
    <!-- = results/cpu/locomotion/terrain.json terrain=ramp/crossed 100*.3g -->100<!-- -->
    <!-- = results/cpu/tables/safety.csv "In-Distribution, CBF" collision .3g -->0<!-- -->

A key of JSON leads through objects by name and through lists by a field that has a value or by position; several keys
are added up. A row and a column lead to our number in a table's CSV; where blocks of it have the same rows, a third key
is part of the block's title. The last word formats the number, times a factor if it begins so. If it ends in †, one
follows the number where the table has one. A whole table is

    <!-- = results/cpu/tables/safety.md -->
    <!-- -->

In place of a file, `kept SCALE` is the table of the policies kept along the runs of a scale, as judged on dev, and
`generalization SCALE` that of its arms on the terrain of training and on dev's.
"""

from __future__ import annotations

import csv
import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md")))
QUOTED = re.compile(r"(<!-- = (?P<source>[^\n]+?) -->)(?P<shown>.*?)(<!-- -->)", re.DOTALL)
KEPT = {
    "sr_45_all": "SR@45", "sr_45_same": "same level", "sr_45_cross": "cross level",
    "sr_120_all": "SR@120", "sr_120_same": "same level", "sr_120_cross": "cross level",
}  # fmt: skip

SEEN = {
    "sr_45_all": "SR@45", "sr_45_cross": "SR@45, cross level",
    "sr_120_all": "SR@120", "sr_120_cross": "SR@120, cross level",
}  # fmt: skip


class SourceError(Exception):
    """A comment names nothing that is there."""


def value(source: str) -> str:
    """What a comment says that stands behind it.

    Raises:
        SourceError: There is no such file, key or format.
    """
    try:
        file, *keys = shlex.split(source)
        if file in TABLES:
            return f"\n\n{TABLES[file](*keys)}\n\n"
        path = ROOT / file
        if path.suffix == ".md":
            return f"\n\n{path.read_text('utf-8').strip()}\n\n"
        *keys, form = keys
        number, dagger = {".json": _of_json, ".csv": _of_csv}[path.suffix](path, *keys)
        factor, _, plain = form.removesuffix("†").rpartition("*")
        return f"{number * float(factor or 1):{plain}}" + "†" * (dagger and form.endswith("†"))
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise SourceError(f"{source}: {error}") from error


def _of_json(path: Path, *keys: str) -> tuple[float, bool]:
    content = json.loads(path.read_text("utf-8"))
    return sum([_at(content, key) for key in keys]), False


def _at(found: Any, keys: str) -> float:
    for key in keys.split("/"):
        name, _, wanted = key.partition("=")
        if wanted:
            (found,) = [item for item in found if str(item[name]) == wanted]
        else:
            found = found[int(name)] if isinstance(found, list) else found[name]
    return float(found)


def _of_csv(path: Path, row: str, column: str, block: str = "") -> tuple[float, bool]:
    with path.open(encoding="utf-8") as file:
        found = {
            line["block"]: (float(line["value"]), line["dagger"] == "1")
            for line in csv.DictReader(file)
            if (line["source"], line["row"], line["column"]) == ("ours", row, column) and block in line["block"]
        }
    if len(found) != 1:
        raise KeyError(f"{row}, {column} is in {'; '.join(found) or 'no block'}; name one of them")
    return found.popitem()[1]


def _kept(scale: str) -> str:
    lines = ["| arm | seed | steps | " + " | ".join(KEPT.values()) + " | SPL |", "|---" * (len(KEPT) + 4) + "|"]
    rows = []
    for path in (ROOT / "results" / scale).glob("*/seed-*/kept.csv"):
        with path.open(encoding="utf-8") as file:
            run = path.parts[-3], int(path.parts[-2].removeprefix("seed-"))
            rows += [(int(row["steps"]), *run, row) for row in csv.DictReader(file)]
    if not rows:
        raise KeyError(f"no kept policies at {scale}")
    for steps, arm, seed, row in sorted(rows, key=lambda found: found[:3]):
        rates = " | ".join(f"{float(row[key]):.1f}" for key in KEPT)
        lines.append(f"| {arm} | {seed} | {steps / 1e6:.1f} M | {rates} | {float(row['spl']):.3f} |")
    return "\n".join(lines)


def _generalization(scale: str) -> str:
    lines = ["| arm | seed | tiles | " + " | ".join(SEEN.values()) + " |", "|---" * (len(SEEN) + 3) + "|"]
    for path in sorted((ROOT / "results" / scale).glob("*/seed-*/generalization.json")):
        seen, unseen = json.loads(path.read_text("utf-8"))
        shown = " | ".join(f"{seen[rate]:.1f}, {unseen[rate]:.1f}" for rate in SEEN)
        arm, seed = path.parts[-3], path.parts[-2].removeprefix("seed-")
        lines.append(f"| {arm} | {seed} | {seen['tiles']} | {shown} |")
    if not lines[2:]:
        raise KeyError(f"no arm was held against the terrain of its training at {scale}")
    return "\n".join(lines)


TABLES = {"kept": _kept, "generalization": _generalization}


def written(text: str) -> str:
    """A page with the numbers that its comments name.

    Raises:
        SourceError: A comment names nothing that is there, or does not end.
    """
    if text.count("<!-- = ") != len(QUOTED.findall(text)):
        raise SourceError("a comment that begins with `<!-- = ` has no `<!-- -->` behind it")
    return QUOTED.sub(lambda found: found[1] + value(found["source"]) + found[4], text)


def outdated() -> list[Path]:
    """Pages whose numbers are not those of the results.

    Raises:
        SourceError: A comment on a page names nothing that is there.
    """
    return [page for page in PAGES if written(text := page.read_text("utf-8")) != text]


if __name__ == "__main__":
    try:
        for page in outdated():
            page.write_text(written(page.read_text("utf-8")), "utf-8")
            print(page)
    except SourceError as error:
        sys.exit(f"error: {error}")
