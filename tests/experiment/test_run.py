from __future__ import annotations

import errno
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.config import Config
from romnav.errors import RomnavError
from romnav.experiment import store
from romnav.experiment.plan import Stage
from romnav.experiment.run import execute, pending, require_trained, require_walking

KEYS = "abcdef"


class Settings(Config):
    a: int = 0
    b: int = 0
    c: int = 0
    d: int = 0
    e: int = 0
    f: int = 0


def stage(folder: Path, key: str, settings: Settings, upstream: tuple[Stage, ...] = (), **more: Any) -> Stage:
    """A stage named after the setting that it uses."""
    place = folder / key
    more = {"kind": "copy", "outputs": ("out.txt",), **more}
    return Stage(
        name=key,
        folder=place,
        record=place / "record.json",
        settings=settings,
        uses=(key,),
        upstream=upstream,
        **more,
    )


class Actions(dict):
    """Stages that write down their setting and what they read, and that are counted."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        super().__init__(copy=self.copy_, policy=self.copy_)

    def copy_(self, stage: Stage, progress: Callable[[int, int, str], None]) -> dict[str, Any]:
        self.ran.append(stage.name)
        read = [(above.folder / "out.txt").read_text() for above in stage.upstream]
        stage.folder.mkdir(parents=True, exist_ok=True)
        (stage.folder / "out.txt").write_text(json.dumps([stage.spec, read]))
        return {"steps": 7}


def run(targets: list[Stage], **options: Any) -> list[str]:
    actions = Actions()
    execute(pending(targets, **options), actions)
    return actions.ran


graphs = st.integers(1, 6).flatmap(
    lambda n: st.tuples(*(st.sets(st.integers(0, k - 1)) if k else st.just(set()) for k in range(n)))
)


def build(folder: Path, graph: tuple[set[int], ...], settings: Settings) -> list[Stage]:
    stages: list[Stage] = []
    for k, above in enumerate(graph):
        stages.append(stage(folder, KEYS[k], settings, tuple(stages[i] for i in sorted(above))))
    return stages


@given(graph=graphs, data=st.data())
@settings(max_examples=25, deadline=None)
def test_a_changed_setting_reruns_exactly_the_stages_that_depend_on_it(graph: Any, data: Any) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        before = build(folder, graph, Settings())
        assert sorted(run(before)) == [*KEYS[: len(graph)]]
        assert run(before) == []
        changed = data.draw(st.integers(0, len(graph) - 1))
        dependents = {changed}
        for k, above in enumerate(graph):  # upstream stages come first
            if above & dependents:
                dependents.add(k)
        after = build(folder, graph, Settings(**{KEYS[changed]: 1}))
        ran = run(after)
        assert sorted(ran) == sorted(KEYS[k] for k in dependents)
        assert all(ran.index(KEYS[i]) < ran.index(KEYS[k]) for k in dependents for i in graph[k] & dependents)
        assert run(after) == []


@pytest.fixture
def chain(tmp_path: Path) -> list[Stage]:
    return build(tmp_path, (set(), {0}, {1}), Settings())


def test_only_what_the_target_needs_is_run(chain: list[Stage]) -> None:
    assert run(chain[1:2]) == ["a", "b"]
    assert run(chain) == ["c"]


def test_a_missing_output_is_made_again_only_where_it_is_read(chain: list[Stage]) -> None:
    run(chain)
    (chain[0].folder / "out.txt").unlink()
    assert run(chain[2:]) == []
    assert run(chain[:1]) == ["a"]
    assert run(chain) == []  # the same bytes came out


def test_another_upstream_output_reruns_what_read_the_old_one(chain: list[Stage]) -> None:
    run(chain)
    (chain[0].folder / "out.txt").write_text("made by another machine")
    record = store.read(chain[0])
    assert record is not None
    store.finish(chain[0], record, {}, 0.0)
    assert run(chain) == ["b", "c"]


def test_a_truncated_output_is_an_error_and_not_used(chain: list[Stage]) -> None:
    run(chain)
    output = chain[1].folder / "out.txt"
    output.write_bytes(output.read_bytes()[:-3])
    with pytest.raises(RomnavError, match=r"b/out\.txt: not the file that record\.json recorded"):
        pending(chain)


def test_a_damaged_record_is_an_error(chain: list[Stage]) -> None:
    run(chain)
    chain[0].record.write_text(chain[0].record.read_text()[:40])
    with pytest.raises(RomnavError, match=r"a/record\.json: damaged record"):
        pending(chain)


def test_stages_run_again_on_request_with_those_that_need_them(tmp_path: Path) -> None:
    a = stage(tmp_path, "a", Settings())
    b = stage(tmp_path, "b", Settings(), (a,), kind="policy")
    c = stage(tmp_path, "c", Settings(), (b,))
    run([c])
    assert run([c], again=("policy",)) == ["b", "c"]


def test_an_edited_versioned_file_reruns_what_reads_it(tmp_path: Path) -> None:
    episodes = tmp_path / "paired.json"
    episodes.write_text("1")
    run([stage(tmp_path, "a", Settings(), reads=(episodes,))])
    assert run([stage(tmp_path, "a", Settings(), reads=(episodes,))]) == []
    episodes.write_text("2")
    assert run([stage(tmp_path, "a", Settings(), reads=(episodes,))]) == ["a"]


def test_what_is_finished_stays_when_a_later_stage_fails(chain: list[Stage]) -> None:
    actions = Actions()

    def full(stage: Stage, progress: Any) -> dict[str, Any]:
        if stage.name == "b":
            raise OSError(errno.ENOSPC, "No space left on device", str(stage.folder / "x.tmp"))
        return actions.copy_(stage, progress)

    with pytest.raises(RomnavError, match=r"b/x\.tmp: cannot be written \(no space left on device\); free some"):
        execute(pending(chain), {"copy": full})
    assert run(chain) == ["b", "c"]


def test_an_error_that_is_no_full_disk_is_not_hidden(chain: list[Stage]) -> None:
    def broken(stage: Stage, progress: Any) -> dict[str, Any]:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "x")

    with pytest.raises(FileNotFoundError):
        execute(pending(chain), {"copy": broken})


@pytest.fixture
def resumable(tmp_path: Path) -> Callable[[Settings], Stage]:
    return lambda settings: stage(tmp_path, "a", settings, scratch=("checkpoint.pt",))


def interrupt(stage: Stage, progress: Any) -> dict[str, Any]:
    checkpoint = stage.folder / "checkpoint.pt"
    checkpoint.write_text(checkpoint.read_text() + "+" if checkpoint.exists() else "1")
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("second", "resume", "expected"),
    [
        (Settings(), True, "1+"),
        (Settings(), False, "1"),
        (Settings(a=1), True, "1"),
        (Settings(b=1), True, "1+"),
    ],
    ids=["resumed", "started over", "changed", "something else changed"],
)
def test_an_interrupted_stage_resumes_only_its_own_checkpoint(
    resumable: Callable[[Settings], Stage], second: Settings, resume: bool, expected: str
) -> None:
    for chosen, keep in ((Settings(), True), (second, resume)):
        with pytest.raises(KeyboardInterrupt):
            execute(pending([resumable(chosen)]), {"copy": interrupt}, resume=keep)
    assert (resumable(second).folder / "checkpoint.pt").read_text() == expected
    assert run([resumable(second)]) == ["a"]


def test_a_folder_that_cannot_be_written_fails_before_the_work(
    resumable: Callable[[Settings], Stage], tmp_path: Path
) -> None:
    (tmp_path / "a").write_text("a file in place of the folder")
    actions = Actions()
    with pytest.raises(RomnavError, match="cannot be written"):
        execute([resumable(Settings())], actions)
    assert actions.ran == []


def test_the_record_tells_what_made_the_output(chain: list[Stage]) -> None:
    run(chain)
    record = store.read(chain[1])
    assert record is not None
    assert record.spec["b"] == 0
    assert record.facts == {"steps": 7}
    assert record.upstream == {"a": store.read(chain[0]).outputs}  # type: ignore[union-attr]
    assert {"commit", "torch", "python", "machine"} <= set(record.provenance)


def test_changed_settings_are_named(chain: list[Stage], tmp_path: Path) -> None:
    run(chain)
    said: list[str] = []
    after = build(tmp_path, (set(), {0}, {1}), Settings(b=3))
    execute(pending(after), Actions(), say=said.append)
    assert said == ["b (changed: b: 0 -> 3)", "c"]


def test_evaluation_requires_trained_policies(tmp_path: Path) -> None:
    def evaluation(settings: Settings) -> list[Stage]:
        policy = stage(tmp_path, "a", settings, kind="policy", arm="rom")
        return [stage(tmp_path, "b", settings, (policy,))]

    with pytest.raises(RomnavError, match="a is not trained; run `romnav train policy rom`"):
        require_trained(evaluation(Settings()))
    run(evaluation(Settings()))
    require_trained(evaluation(Settings()))
    with pytest.raises(RomnavError, match=r"a was trained with other settings \(a: 0 -> 1\)"):
        require_trained(evaluation(Settings(a=1)))


def test_no_locomotion_policy_is_trained_by_accident(tmp_path: Path) -> None:
    walked = stage(tmp_path, "a", Settings(), kind="locomotion")
    library = stage(tmp_path, "b", Settings(), (walked,), kind="gaits")
    episodes = stage(tmp_path, "c", Settings(), (walked, library), kind="episodes")
    actions = dict.fromkeys(("locomotion", "gaits", "episodes"), Actions().copy_)
    require_walking(pending([library]))
    with pytest.raises(RomnavError, match=r"robots of c is not trained to the end; run `romnav train locomotion`"):
        require_walking(pending([episodes]))
    execute(pending([library]), actions)
    require_walking(pending([episodes]))
    changed = stage(tmp_path, "a", Settings(a=5), kind="locomotion")
    with pytest.raises(RomnavError, match=r"trained with other settings \(a: 0 -> 5\)"):
        require_walking(pending([stage(tmp_path, "c", Settings(), (changed,), kind="episodes")]))
