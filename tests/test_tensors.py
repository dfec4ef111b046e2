from __future__ import annotations

import os
import pickle
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from romnav import arrays
from romnav.errors import RomnavError
from romnav.evaluation import episodes, tracks
from romnav.evaluation.paired import rows
from romnav.evaluation.trials import rows as trial_rows
from romnav.navigation import checkpoint
from romnav.robot.gaits import GaitLibrary
from romnav.robot.locomotion.train import load_policy
from romnav.sensing import encoder
from romnav.tensors import Kind

KIND = Kind("romnav-test-1", "test file", "write it again")


class Bomb:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


PAYLOADS: dict[str, Callable[[Path, Any], object]] = {
    "pickle": lambda path, bomb: path.write_bytes(pickle.dumps(bomb)),
    "torch": lambda path, bomb: torch.save({"format": "romnav-policy-1", "weights": bomb}, path),
    "old torch": lambda path, bomb: torch.save({"weights": bomb}, path, _use_new_zipfile_serialization=False),
    "npz": lambda path, bomb: np.savez(path.open("wb"), first=np.array([bomb], object)),
}
READERS: dict[str, Callable[[Path], object]] = {
    "policy": checkpoint.read,
    "encoder": encoder.load,
    "locomotion": load_policy,
    "gaits": GaitLibrary.load,
    "tracks": tracks.read,
    "episode rows": rows.read,
    "trial rows": trial_rows.read,
    "episode set": episodes.load,
}


@pytest.mark.parametrize("payload", PAYLOADS)
def test_code_in_a_file_is_never_run(tmp_path: Path, payload: str) -> None:
    path, marker = tmp_path / "file", tmp_path / "marker"
    PAYLOADS[payload](path, Bomb(marker))
    for reader in READERS.values():
        with pytest.raises(RomnavError) as caught:
            reader(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
    assert arrays.load(path) is None
    assert not marker.exists()


def test_the_bomb_works(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Bomb(tmp_path / "marker")))
    assert (tmp_path / "marker").exists()


def test_content_comes_back(tmp_path: Path) -> None:
    content = {"weights": {"a": torch.arange(6).reshape(2, 3)}, "text": "x", "numbers": [1, 2.5, None, True]}
    KIND.save(tmp_path / "file", content)
    stored = KIND.load(tmp_path / "file")
    assert torch.equal(stored.pop("weights")["a"], content["weights"]["a"])  # type: ignore[index]
    assert stored == {"format": KIND.format, "text": "x", "numbers": [1, 2.5, None, True]}


def test_damage_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "file"
    KIND.save(path, {"weights": torch.zeros(1000), "more": {"text": "abc"}})
    whole, luck = path.read_bytes(), random.Random(0)
    for trial in range(60):
        place = luck.randrange(len(whole))
        flipped = bytes([whole[place] ^ 1 << luck.randrange(8)])
        path.write_bytes(whole[:place] + (flipped + whole[place + 1 :] if trial % 2 else b""))
        message = ""
        try:
            stored = KIND.load(path)
        except RomnavError as error:
            message = str(error)
        if message:
            assert message.startswith(f"{path}: ")
            assert "\n" not in message
        else:  # what fills up the archive is no content
            assert not stored["weights"].any()


def test_a_missing_file_and_one_of_another_kind_are_named(tmp_path: Path) -> None:
    with pytest.raises(RomnavError, match="none: no such test file; write it again"):
        KIND.load(tmp_path / "none")
    torch.save([1], tmp_path / "list")
    with pytest.raises(RomnavError, match="list: key 'format' is not 'romnav-test-1'"):
        KIND.load(tmp_path / "list")
    with pytest.raises(RomnavError, match="damaged, or no test file"):
        KIND.load(tmp_path)


def test_the_committed_walking_policy_and_gaits_can_be_read() -> None:
    folder = Path(__file__).parents[1] / "results" / "cpu" / "locomotion"
    _, policy, iterations = load_policy(folder / "policy.pt")
    assert iterations > 0
    assert policy(torch.zeros(2, 114)).isfinite().all()
    assert GaitLibrary.load(folder / "gaits.pt").has("stair", 1)
