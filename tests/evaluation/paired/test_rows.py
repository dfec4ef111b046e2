from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from romnav.errors import RomnavError
from romnav.evaluation.paired import rows


def test_written_rows_are_read_back(episode_rows, tmp_path: Path) -> None:
    made = episode_rows("rom", seed=3)
    path = tmp_path / "arm" / "episodes.parquet"
    rows.write(path, made)
    read = rows.read(path)
    assert (read.arm, read.seed, len(read), read.source) == ("rom", 3, len(made), str(path))
    assert read.provenance == made.provenance
    for name in rows.SCHEMA.names:
        np.testing.assert_array_equal(read.columns[name], made.columns[name])
    assert pq.read_schema(path).remove_metadata() == rows.SCHEMA
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_reading_does_not_import_pandas(episode_rows, tmp_path: Path) -> None:
    path = tmp_path / "rows"
    rows.write(path, episode_rows())
    script = (
        "import sys; from pathlib import Path; from romnav.report.paired import results, tables; "
        f"results.rows.read(Path({str(path)!r})); "
        "sys.exit(bool({'pandas', 'torch', 'warp', 'mujoco'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


def test_equal_rows_give_equal_files(episode_rows, tmp_path: Path) -> None:
    for name in ("a", "b"):
        rows.write(tmp_path / name, episode_rows())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_rows_are_put_in_order_of_the_episodes(episode_rows) -> None:
    made = episode_rows()
    order = np.random.default_rng(0).permutation(len(made))
    shuffled = rows.make({name: c[order] for name, c in made.columns.items()}, made.provenance)
    for name in rows.SCHEMA.names:
        np.testing.assert_array_equal(shuffled.columns[name], made.columns[name])


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("level", "upper", "impossible level"),
        ("tile_class", "", "impossible tile_class"),
        ("outcome", "crash", "impossible outcome"),
        ("success_time", 121.0, "impossible success_time"),
        ("geodesic", np.inf, "impossible geodesic"),
        ("path_length", -1.0, "impossible path_length"),
        ("final_distance", np.nan, "impossible final_distance"),
        ("goal_z", np.nan, "impossible goal_z"),
        ("collisions", -1, "impossible collisions"),
        ("where", "on the moon", "impossible where"),
        ("how", "flew", "impossible how"),
        ("arm", "other", "impossible arm"),
        ("episode", 6, "occur twice"),
        ("episode", 99, "5, 64, 65, ... .36 in all. missing"),
    ],
)
def test_an_impossible_value_is_named(episode_rows, column: str, value: object, message: str) -> None:
    made = episode_rows()
    columns = {name: c.copy() for name, c in made.columns.items()}
    columns[column][5] = value
    with pytest.raises(RomnavError, match=f"somewhere.*{message}"):
        rows.make(columns, made.provenance, "somewhere")


def test_a_success_without_a_time_is_impossible(episode_rows) -> None:
    made = episode_rows(skill=1.0)
    solved = int(np.flatnonzero(made.columns["outcome"] == "success")[0])
    columns = {name: c.copy() for name, c in made.columns.items()}
    columns["success_time"][solved] = np.nan
    with pytest.raises(RomnavError, match=f"episode {solved} has an impossible outcome"):
        rows.make(columns, made.provenance)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("path_length"), "path_length missing"),
        (lambda c: c.update(extra=c["time"]), "unknown column.*extra"),
        (lambda c: c.update(episode=c["time"]), "episode must hold int64, not float64"),
        (lambda c: c.update(time=c["time"][:-1]), "different lengths"),
        (lambda c: c.update({name: value[:0] for name, value in c.items()}), "empty"),
    ],
)
def test_columns_are_checked(episode_rows, change, message: str) -> None:
    made = episode_rows()
    columns = dict(made.columns)
    change(columns)
    with pytest.raises(RomnavError, match=message):
        rows.make(columns, made.provenance)


def test_unreadable_files_are_named(episode_rows, tmp_path: Path) -> None:
    whole, path = tmp_path / "whole", tmp_path / "rows"
    rows.write(whole, episode_rows())
    with pytest.raises(RomnavError, match="no such file"):
        rows.read(path)
    path.write_bytes(whole.read_bytes()[:-100])
    with pytest.raises(RomnavError, match="truncated"):
        rows.read(path)
    table = pq.read_table(whole)
    metadata = dict(table.schema.metadata)
    pq.write_table(table.replace_schema_metadata({**metadata, b"romnav.rows": b"99"}), path)
    with pytest.raises(RomnavError, match="schema version 99, not 2"):
        rows.read(path)
    broken = metadata[b"romnav.provenance"].replace(b'"scale"', b'"scald"')
    pq.write_table(table.replace_schema_metadata({**metadata, b"romnav.provenance": broken}), path)
    with pytest.raises(RomnavError, match="provenance key scale"):
        rows.read(path)


def test_a_failed_write_leaves_the_old_file(episode_rows, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "rows"
    rows.write(path, episode_rows())
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RomnavError, match="rows: cannot be written"):
        rows.write(path, episode_rows("other"))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_runs_are_grouped_into_arms_by_seed(episode_rows) -> None:
    runs = [episode_rows("b", seed=1), episode_rows("a"), episode_rows("b", seed=0)]
    arms = rows.pair(runs)
    assert [(arm.name, [run.seed for run in arm.runs]) for arm in arms] == [("b", [0, 1]), ("a", [0])]


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"episode_set": "beef"}, "a/seed-0 and b/seed-0.*feedc0ffee123456 and beef; evaluate both"),
        ({"n": 32}, "a/seed-0 and b/seed-0: 64 and 32 episodes"),
        ({"arm": "a"}, "a/seed-0 and a/seed-0: both hold a, seed 0"),
    ],
)
def test_runs_that_cannot_be_compared(episode_rows, other: dict, message: str) -> None:
    with pytest.raises(RomnavError, match=message):
        rows.pair([episode_rows("a"), episode_rows(**{"arm": "b", **other})])


@pytest.mark.parametrize(("setting", "value"), [("duration", 45.0), ("reach", 1.0)])
def test_arms_evaluated_with_other_settings_cannot_be_compared(episode_rows, setting: str, value: float) -> None:
    usual = {"duration": 120.0, "reach": 0.5}
    a, b, old = episode_rows("a", **usual), episode_rows("b", **{**usual, setting: value}), episode_rows("c")
    assert len(rows.pair([a, episode_rows("b", **usual), old])) == 3
    with pytest.raises(RomnavError, match=rf"a/seed-0 and b/seed-0: .* a {setting} of .*evaluation\.{setting}"):
        rows.pair([a, b])


def test_a_flipped_bit_is_found(episode_rows, tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    rows.write(path, episode_rows(n=256))
    whole = path.read_bytes()
    for place in range(4, len(whole) - 4, len(whole) // 40):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        try:
            read = rows.read(path)
        except RomnavError as error:
            assert str(path) in str(error)  # noqa: PT017
        else:  # not all of the footer is needed
            for name, column in episode_rows(n=256).columns.items():
                np.testing.assert_array_equal(read.columns[name], column)


def test_episodes_of_one_set_must_agree(episode_rows) -> None:
    b = episode_rows("b")
    tile = b.columns["tile"].copy()
    tile[3] += 1
    with pytest.raises(RomnavError, match="differ in tile"):
        rows.pair([episode_rows("a"), rows.make({**b.columns, "tile": tile}, b.provenance, "b")])
