from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from romnav.errors import RomnavError
from romnav.evaluation.trials import rows as trial_rows


def test_rows_survive_the_disk(trial_run, tmp_path: Path) -> None:
    run = trial_run("rom", seed=2)
    trial_rows.write(tmp_path / "safety.parquet", run)
    read = trial_rows.read(tmp_path / "safety.parquet")
    assert (read.arm, read.seed, read.provenance) == ("rom", 2, run.provenance)
    for name, column in run.columns.items():
        if name in ("hits", "track"):
            assert all(np.array_equal(a, b) for a, b in zip(column, read.columns[name], strict=True))
        else:
            assert np.array_equal(column, read.columns[name], equal_nan=column.dtype.kind == "f")
    assert read.scenes == ["in-distribution", "out-of-distribution", "adversarial"]
    on = read.of("adversarial", True)
    assert np.array_equal(on["trial"], np.arange(len(on["trial"])))
    assert read.tracks("adversarial", True)[0].shape[1] == 3


def test_what_cannot_be_is_one_clear_error(trial_run, tmp_path: Path) -> None:
    path = tmp_path / "safety.parquet"
    with pytest.raises(RomnavError, match="no such file of trials; run the experiment first"):
        trial_rows.read(path)
    path.write_bytes(b"PAR1 and no more")
    with pytest.raises(RomnavError, match="not a readable parquet file"):
        trial_rows.read(path)
    for name, value, message in (
        ("collisions", 7, "row 0 has an impossible collisions"),
        ("time", -1.0, "row 0 has an impossible time"),
        ("outcome", "lost", "row 0 has an impossible outcome"),
        ("trial", 1, "trials with the filter off and on do not pair"),
    ):
        run = trial_run("rom")
        columns = {key: column.copy() for key, column in run.columns.items()}
        columns[name][0] = value
        trial_rows.write(path, trial_rows.TrialRows(run.arm, run.seed, columns, run.provenance))
        with pytest.raises(RomnavError, match=message):
            trial_rows.read(path)


def test_other_files_are_refused(episode_rows, tmp_path: Path) -> None:
    from romnav.evaluation.paired import rows

    rows.write(tmp_path / "episodes.parquet", episode_rows())
    with pytest.raises(RomnavError, match="schema version none"):
        trial_rows.read(tmp_path / "episodes.parquet")
