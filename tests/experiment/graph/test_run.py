from __future__ import annotations

import errno
import json
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.config import Config
from romnav.errors import RomnavError
from romnav.experiment.graph import records
from romnav.experiment.graph.cluster import execute_on_ray
from romnav.experiment.graph.run import execute, pending, prepare, require, start_over, waves, with_all_above
from romnav.experiment.graph.stage import Session, Stage

KEYS = "abcdef"


class Settings(Config):
    a: int = 0
    b: int = 0
    c: int = 0
    d: int = 0
    e: int = 0
    f: int = 0


def write(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
    """Writes down the stage's setting and what it reads."""
    read = [(above.folder / "out.txt").read_text() for above in stage.upstream]
    stage.folder.mkdir(parents=True, exist_ok=True)
    (stage.folder / "out.txt").write_text(json.dumps([stage.spec, read]))
    return {"steps": 7}


def stage(folder: Path, key: str, settings: Settings, upstream: tuple[Stage, ...] = (), **more: Any) -> Stage:
    """A stage named after the setting that it uses."""
    place = folder / key
    more = {"kind": "copy", "outputs": ("out.txt",), "make": write, **more}
    return Stage(
        name=key,
        folder=place,
        record=place / "record.json",
        settings=settings,
        uses=(key,),
        upstream=upstream,
        **more,
    )


def run(targets: list[Stage], **options: Any) -> list[str]:
    """Names of the stages that ran."""
    stages = pending(targets, **options)
    execute(stages, Session())
    return [stage.name for stage in stages]


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
    record = records.read(chain[0])
    assert record is not None
    records.finish(chain[0], record, None, {}, 0.0)
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


def test_a_record_that_was_changed_anywhere_is_an_error(chain: list[Stage]) -> None:
    """It may still be JSON with every key; one without a checksum, of an older version, is believed."""
    run(chain)
    record = chain[0].record
    whole = json.loads(record.read_text())
    record.write_text(json.dumps({**whole, "facts": {"steps": 8}}))
    with pytest.raises(RomnavError, match=r"a/record\.json: damaged record \(its content .* sha256 .*\); restore it"):
        pending(chain)
    record.write_text(json.dumps(whole))  # laid out in another way
    assert pending(chain) == []
    del whole["sha256"]
    record.write_text(json.dumps(whole))
    assert pending(chain) == []


def test_stages_run_again_on_request_with_those_that_need_them(tmp_path: Path) -> None:
    a = stage(tmp_path, "a", Settings())
    b = stage(tmp_path, "b", Settings(), (a,))
    c = stage(tmp_path, "c", Settings(), (b,))
    run([c])
    assert run([c], again=[b]) == ["b", "c"]
    assert run([c], again=with_all_above([c])) == ["a", "b", "c"]


def test_an_edited_versioned_file_reruns_what_reads_it(tmp_path: Path) -> None:
    episodes = tmp_path / "paired.json"
    episodes.write_text("1")
    run([stage(tmp_path, "a", Settings(), reads=(episodes,))])
    assert run([stage(tmp_path, "a", Settings(), reads=(episodes,))]) == []
    episodes.write_text("2")
    assert run([stage(tmp_path, "a", Settings(), reads=(episodes,))]) == ["a"]


def test_what_is_finished_stays_when_a_later_stage_fails(chain: list[Stage]) -> None:
    def full(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        raise OSError(errno.ENOSPC, "No space left on device", str(stage.folder / "x.tmp"))

    with pytest.raises(RomnavError, match=r"b/x\.tmp: cannot be written \(no space left on device\); free some"):
        execute([chain[0], replace(chain[1], make=full), chain[2]], Session())
    assert run(chain) == ["b", "c"]


def test_an_error_that_is_no_full_disk_is_not_hidden(chain: list[Stage]) -> None:
    def broken(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "x")

    with pytest.raises(FileNotFoundError):
        execute([replace(chain[0], make=broken)], Session())


@pytest.fixture
def resumable(tmp_path: Path) -> Callable[[Settings], Stage]:
    return lambda settings: stage(tmp_path, "a", settings, scratch=("checkpoint.pt",))


def interrupt(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
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
            execute([replace(resumable(chosen), make=interrupt)], Session(resume=keep))
    assert (resumable(second).folder / "checkpoint.pt").read_text() == expected
    assert run([resumable(second)]) == ["a"]


def half(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
    """Leaves a checkpoint that names its setting."""
    (stage.folder / "checkpoint.pt").write_text(str(stage.spec["a"]))
    raise KeyboardInterrupt


def test_a_checkpoint_is_found_again_when_a_setting_is_changed_back(resumable: Callable[[Settings], Stage]) -> None:
    found = []
    for a, make in ((0, half), (1, half), (2, half), (1, interrupt), (0, interrupt)):
        with pytest.raises(KeyboardInterrupt):
            execute([replace(resumable(Settings(a=a)), make=make)], Session())
        found.append((resumable(Settings()).folder / "checkpoint.pt").read_text())
    assert found == ["0", "1", "2", "1+", "0+"]


def test_a_finished_run_is_found_again_when_a_setting_is_changed_back(resumable: Callable[[Settings], Stage]) -> None:
    first, second = resumable(Settings()), resumable(Settings(a=1))
    assert run([first]) == ["a"]
    before = (first.folder / "out.txt").read_text()
    with pytest.raises(KeyboardInterrupt):
        execute([replace(second, make=interrupt)], Session())
    assert not (first.folder / "out.txt").exists()

    def work(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        raise AssertionError("ran")

    execute([replace(first, make=work)], Session())
    assert (first.folder / "out.txt").read_text() == before
    assert pending([first]) == []
    with pytest.raises(KeyboardInterrupt):
        execute([replace(second, make=half)], Session())
    assert not (first.folder / "replaced" / second.key[:16]).exists()


@pytest.mark.parametrize("moves", range(4))
def test_putting_a_run_aside_can_be_interrupted_anywhere(
    resumable: Callable[[Settings], Stage], moves: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (replace(resumable(Settings(a=a)), beside=("curve.csv",)) for a in (0, 1))

    def begun(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        (stage.folder / "curve.csv").write_text("rows")
        return half(stage, session, progress)

    with pytest.raises(KeyboardInterrupt):
        execute([replace(first, make=begun)], Session())
    made, rename = [0], Path.rename

    def breaks(self: Path, target: Path) -> Path:
        if made[0] == moves:
            raise KeyboardInterrupt
        made[0] += 1
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", breaks)
    with pytest.raises(KeyboardInterrupt):
        execute([replace(second, make=interrupt)], Session())
    monkeypatch.undo()
    with pytest.raises(KeyboardInterrupt):
        execute([replace(first, make=interrupt)], Session())
    assert (first.folder / "checkpoint.pt").read_text() == "0+"
    assert (first.folder / "curve.csv").read_text() == "rows"


def test_two_processes_that_need_a_stage_make_it_once(tmp_path: Path) -> None:
    one = stage(tmp_path, "a", Settings())
    began, go = threading.Event(), threading.Event()

    def slow(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        began.set()
        assert go.wait(30)
        return write(stage, session, progress)

    first = threading.Thread(target=execute, args=([replace(one, make=slow)], Session()))
    first.start()
    assert began.wait(30)
    said: list[str] = []

    def say(line: str) -> None:
        said.append(line)
        if "waiting for process" in line:
            go.set()

    def work(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        raise AssertionError("ran")

    execute([replace(one, make=work)], Session(), say)
    first.join()
    assert said[-1] == "a is there"


def test_a_folder_that_cannot_be_written_fails_before_the_work(
    resumable: Callable[[Settings], Stage], tmp_path: Path
) -> None:
    (tmp_path / "a").write_text("a file in place of the folder")

    def work(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        raise AssertionError("ran")

    with pytest.raises(RomnavError, match="cannot be written"):
        execute([replace(resumable(Settings()), make=work)], Session())


def test_the_record_tells_what_made_the_output(chain: list[Stage]) -> None:
    run(chain)
    record = records.read(chain[1])
    assert record is not None
    assert record.spec["b"] == 0
    assert record.facts == {"steps": 7}
    assert record.upstream == {"a": records.read(chain[0]).outputs}  # type: ignore[union-attr]
    assert {"commit", "torch", "python", "machine"} <= set(record.provenance)


def test_changed_settings_are_named(chain: list[Stage], tmp_path: Path) -> None:
    run(chain)
    said: list[str] = []
    after = build(tmp_path, (set(), {0}, {1}), Settings(b=3))
    execute(pending(after), Session(), said.append)
    assert said == ["b (changed: b: 0 -> 3)", "c"]


def test_what_another_stage_needs_is_missing_unfinished_or_changed(tmp_path: Path) -> None:
    def needed(settings: Settings, **more: Any) -> Stage:
        return stage(tmp_path, "a", settings, command=("train", "policy", "rom"), scratch=("checkpoint.pt",), **more)

    reader = stage(tmp_path, "b", Settings())
    with pytest.raises(RomnavError, match="a is missing, and b needs it; run `romnav train policy rom`"):
        require(needed(Settings()), reader)
    with pytest.raises(KeyboardInterrupt):
        execute([needed(Settings(), make=interrupt)], Session())
    with pytest.raises(RomnavError, match="a is unfinished, or something that it was made from has changed since"):
        require(needed(Settings()), reader)
    run([needed(Settings())])
    require(needed(Settings()), reader)
    with pytest.raises(RomnavError, match=r"a was made with other settings \(a: 0 -> 1\)"):
        require(needed(Settings(a=1)), reader)


def test_what_is_made_on_request_is_not_made_on_the_way(tmp_path: Path) -> None:
    def long(settings: Settings) -> Stage:
        return stage(tmp_path, "a", settings, command=("train", "locomotion"), on_request=True)

    library = stage(tmp_path, "b", Settings(), (long(Settings()),))
    episodes = stage(tmp_path, "c", Settings(), (library,))
    with pytest.raises(RomnavError, match="a is missing, and b needs it; run `romnav train locomotion`"):
        pending([episodes])
    assert run([long(Settings())]) == ["a"]
    assert run([episodes]) == ["b", "c"]
    assert run([episodes], again=with_all_above([episodes])) == ["b", "c"]
    changed = stage(tmp_path, "b", Settings(), (long(Settings(a=5)),))
    with pytest.raises(RomnavError, match=r"a was made with other settings \(a: 0 -> 5\)"):
        pending([changed])


@given(graph=graphs)
def test_a_wave_needs_nothing_of_itself_or_later(graph: tuple[set[int], ...]) -> None:
    stages = build(Path("nowhere"), graph, Settings())
    groups = waves(stages)
    assert sorted(stage.name for group in groups for stage in group) == [*KEYS[: len(graph)]]
    done: set[str] = set()
    for group in groups:
        assert all(above.name in done for stage in group for above in stage.upstream)
        done |= {stage.name for stage in group}
    assert all(groups)


def test_a_record_stays_as_it_is_when_the_same_comes_out(chain: list[Stage]) -> None:
    run(chain)
    before = chain[1].record.read_text()
    (chain[1].folder / "out.txt").unlink()
    assert run(chain[1:2]) == ["b"]
    assert chain[1].record.read_text() == before
    run([stage(chain[1].folder.parent, "b", Settings(b=1), chain[1].upstream)])
    assert chain[1].record.read_text() != before


def test_a_device_that_is_not_there_is_one_clear_error() -> None:
    with pytest.raises(RomnavError, match=r"device cdua: .*; use cpu, cuda or cuda:N"):
        Session("cdua")


def test_what_is_made_on_the_cpu_alone_is_refused_elsewhere_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Session, "__post_init__", lambda session: None)  # there is no such device here
    first = stage(tmp_path, "a", Settings())
    arms = [
        stage(tmp_path, key, Settings(), (first,), arm=arm, cpu_only=True)
        for key, arm in zip("bcd", ("x", "x", None), strict=True)
    ]
    cuda, message = (
        Session("cuda:1"),
        r"^--device cuda:1: x, d: made on the CPU alone, .* then these with --device cpu$",
    )
    with pytest.raises(RomnavError, match=message):
        execute(iter([first, *arms]), cuda)
    with pytest.raises(RomnavError, match=message):
        execute_on_ray("ray", {}, iter([first, *arms]), cuda, print)
    assert not first.record.exists()
    execute([first], cuda)
    execute(iter(arms), Session())
    assert all(made.record.exists() for made in (first, *arms))


def test_a_report_that_was_drawn_without_an_arm_is_not_finished(tmp_path: Path) -> None:
    """By `romnav tables`; `run` then still makes the arm."""
    arms = build(tmp_path, (set(), set(), {0, 1}), Settings())
    run(arms[:1])

    def draw(report: Stage, session: Session, progress: Any) -> dict[str, Any]:
        return write(replace(report, upstream=report.upstream[:1]), session, progress)

    execute([replace(arms[2], make=draw)], Session())
    assert records.drawn(arms[2])
    assert not records.finished(arms[2])
    assert run(arms[2:]) == ["b", "c"]
    assert records.finished(arms[2])


def test_a_report_is_drawn_again_when_what_it_shows_has_changed_and_not_before(chain: list[Stage]) -> None:
    run(chain)
    folder = chain[0].folder.parent
    _, _, report = build(folder, (set(), {0}, {1}), Settings(a=1))
    assert not records.finished(report)  # a is to be made again, and so are b and the report
    assert records.drawn(report)  # but it shows the b that is there
    *_, other = build(folder, (set(), {0}, {1}), Settings(c=1))
    assert not records.drawn(other)
    (chain[1].folder / "out.txt").write_text("made by another machine")
    record = records.read(chain[1])
    assert record is not None
    records.finish(chain[1], record, None, {}, 0.0)
    assert not records.drawn(chain[2])
    (chain[2].folder / "out.txt").unlink()
    assert not records.drawn(report)


@pytest.mark.parametrize("way", ["a file for the folder", "a folder for a file", "a folder that cannot be written"])
def test_what_cannot_be_written_is_known_before_the_first_stage_runs(tmp_path: Path, way: str) -> None:
    first = stage(tmp_path, "a", Settings())
    last = stage(tmp_path, "b", Settings(), (first,))
    if way == "a file for the folder":
        last.folder.write_text("in the way")
    elif way == "a folder for a file":
        (last.folder / "out.txt").mkdir(parents=True)
    else:
        last = replace(last, folder=Path("/proc/romnav"), record=Path("/proc/romnav/record.json"))
    with pytest.raises(RomnavError, match="cannot be written"):
        prepare([first, last])
    assert not (first.folder / "out.txt").exists()


def replace_upstream(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
    """As another process does while this one works."""
    facts = write(stage, session, progress)
    (above,) = stage.upstream
    (above.folder / "out.txt").write_text("made by another process")
    record = records.read(above)
    assert record is not None
    records.finish(above, record, None, {}, 0.0)
    return facts


def test_what_was_replaced_while_it_was_read_is_read_again(tmp_path: Path) -> None:
    first = stage(tmp_path, "a", Settings())
    second = stage(tmp_path, "b", Settings(), (first,), make=replace_upstream)
    run([second])
    assert run([replace(second, make=write)]) == ["b"]
    assert "another process" in (second.folder / "out.txt").read_text()
    assert run([second]) == []


def die(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
    """Replaces its output, and is killed before it is recorded."""
    (stage.folder / "out.txt").write_text("half of it")
    raise KeyboardInterrupt


def test_a_stage_that_was_killed_while_made_again_is_made_again(chain: list[Stage]) -> None:
    run(chain)
    with pytest.raises(KeyboardInterrupt):
        execute([replace(chain[0], make=die)], Session(resume=False))
    assert run(chain) == ["a"]  # the same bytes came out
    with pytest.raises(KeyboardInterrupt):  # so does one that changed settings; its old record stands
        execute([replace(chain[1], make=die, settings=Settings(b=1))], Session())
    old = records.read(chain[1])
    assert old is not None
    assert old.key == chain[1].key


def test_starting_over_keeps_runs_with_other_settings(resumable: Callable[[Settings], Stage]) -> None:
    one, other = resumable(Settings()), resumable(Settings(a=1))
    for stage in (one, other):
        with pytest.raises(KeyboardInterrupt):
            execute([replace(stage, make=half)], Session())
    start_over([one], lambda line: None)
    assert not (one.folder / "checkpoint.pt").exists()
    (aside,) = (one.folder / "replaced").iterdir()
    assert (aside / "checkpoint.pt").read_text() == "1"
