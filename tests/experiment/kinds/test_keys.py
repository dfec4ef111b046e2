"""Which stage needs which, and on which settings its output depends."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from romnav.errors import RomnavError
from romnav.experiment.graph.run import waves
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds import reports, trials
from romnav.experiment.kinds.encoder import encoder, quality
from romnav.experiment.kinds.episodes import episodes
from romnav.experiment.kinds.generalization import generalization
from romnav.experiment.kinds.kept import kept
from romnav.experiment.kinds.locomotion import locomotion
from romnav.experiment.kinds.navigation import navigation
from romnav.experiment.kinds.policy import policy
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from romnav.world.spec import WorldSpec
from tests.experiment import conftest

ROOT = Path(__file__).parents[3]
SCALE = """
[world]
tiles = 4
[lidar]
rows = 15
"""


def workspace(root: Path, scale: str = SCALE) -> Workspace:
    (root / "experiments").mkdir(exist_ok=True, parents=True)
    shutil.copy(ROOT / "experiments" / "spawn-goal.toml", root / "experiments")
    shutil.copytree(ROOT / "experiments" / "published", root / "experiments" / "published", dirs_exist_ok=True)
    return conftest.workspace(root, scale)


def report(work: Workspace, name: str, seeds: list[int]) -> Stage:
    """The only report of an experiment."""
    (stage,) = reports(work, name, seeds)
    return stage


def everything(tables: Stage) -> dict[str, str]:
    """Key of each stage by name."""
    keys = {tables.name: tables.key}
    for stage in tables.upstream:
        keys |= everything(stage)
    return keys


EVALUATED = {f"episodes {arm}, seed 0" for arm in ("rom", "uniform", "nocap", "uniform-nocap")}
SCRIPTED = {"episodes oracle, seed 0", "episodes straight, seed 0"}
TRAINED = {name.replace("episodes", "policy") for name in EVALUATED}
TABLES = {"tables spawn-goal"}


@pytest.mark.parametrize(
    ("section", "change", "rerun"),
    [
        ("world", "tiles = 5", {"encoder lidar"} | TRAINED | EVALUATED | TABLES),
        ("lidar", "rows = 20", {"encoder lidar"} | TRAINED | EVALUATED | TABLES),
        ("pretrain", "epochs = 3", {"encoder lidar"} | TRAINED | EVALUATED | TABLES),
        ("navigation.ppo", "gamma = 0.9", TRAINED | EVALUATED | TABLES),
        ("navigation.policy", "recurrent = 64", TRAINED | EVALUATED | TABLES),
        ("navigation.env", "period = 0.1", TRAINED | EVALUATED | SCRIPTED | TABLES),
        ("evaluation", "reach = 0.4", EVALUATED | SCRIPTED | TABLES),
    ],
)
def test_a_setting_reruns_exactly_what_depends_on_it(
    tmp_path: Path, section: str, change: str, rerun: set[str]
) -> None:
    before = everything(report(workspace(tmp_path), "spawn-goal", [0]))
    name = change.split(" = ")[0]
    kept = "\n".join(line for line in SCALE.splitlines() if not line.startswith(name))
    kept = kept.replace(f"[{section}]", "") if name in SCALE else kept
    after = everything(report(workspace(tmp_path, f"{kept}\n[{section}]\n{change}\n"), "spawn-goal", [0]))
    assert before.keys() == after.keys()
    assert {name for name in before if before[name] != after[name]} == rerun


@pytest.mark.parametrize(
    ("section", "change", "rerun"),
    [
        ("safety.filter.occupancy", "margin = 0.2", {"safety rom", "safety oracle", "safety straight"}),
        ("safety", "trials = 7", {"safety rom", "safety oracle", "safety straight"}),
        ("navigation.ppo", "gamma = 0.9", {"policy rom", "safety rom"}),
        ("deploy", "trials = 7", set()),
        ("evaluation", "reach = 0.4", set()),
    ],
)
def test_trials_are_repeated_where_filter_scenes_or_policy_changed(
    tmp_path: Path, section: str, change: str, rerun: set[str]
) -> None:
    shutil.copytree(ROOT / "experiments", tmp_path / "experiments")
    before, after = (
        everything(reports(workspace(tmp_path, SCALE + more), "safety", [0])[0])
        for more in ("", f"[{section}]\n{change}\n")
    )
    changed = {name.removesuffix(", seed 0") for name in before if before[name] != after[name]}
    assert changed == rerun | ({"report safety"} if rerun else set())


def test_rows_of_a_guarded_arm_depend_on_the_filter(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    guarded = '[arms.{name}]\nlabel = "G"\npolicy = "{policy}"\nfilter = true\n'
    file = here.project.file("guarded")
    file.write_text(
        'kind = "ablation"\ntitle = "t"\n'
        + guarded.format(name="rom-guarded", policy="rom")
        + guarded.format(name="oracle-guarded", policy="oracle")
    )
    arms = ("rom", "rom-guarded", "oracle", "oracle-guarded")
    here = Workspace(Project(tmp_path, tmp_path / "results"), here.scale)
    before = {arm: episodes(here, arm, 0).key for arm in arms}
    assert len({*before.values()}) == 4
    other = workspace(tmp_path, SCALE + "[safety.filter.occupancy]\nmargin = 0.2\n")
    changed = {arm for arm in arms if episodes(other, arm, 0).key != before[arm]}
    assert changed == {"rom-guarded", "oracle-guarded"}
    with pytest.raises(RomnavError, match=r"guarded\.toml: arms\.oracle-guarded\.filter: trials have the filter both"):
        trials.trials(other, "safety", "oracle-guarded", 0)


def test_trials_are_out_of_date_when_a_scene_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "experiments", tmp_path / "experiments")
    here = workspace(tmp_path)
    driven = trials.trials(here, "deploy", "oracle", 0)
    assert {path.name for path in driven.reads} >= {"scene.py", "obstacles.py", "deployments.py"}
    (tmp_path / "scene.py").write_text("another scene")
    monkeypatch.setattr("romnav.experiment.kinds.trials.SCENES", (tmp_path / "scene.py",))
    assert trials.trials(here, "deploy", "oracle", 0).key != driven.key


def test_arms_share_the_settings_of_trials(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("more").write_text('kind = "safety"\ntitle = "t"\n[arms.own]\nlabel = "Own"\nsafety.trials = 3\n')
    with pytest.raises(RomnavError, match=r"arms\.own\.safety: set \[safety\] of the scale"):
        trials.trials(here, "safety", "own", 0)


def test_policies_are_trained_on_tiles_of_their_own_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = everything(report(workspace(tmp_path), "spawn-goal", [0]))
    here = workspace(tmp_path, SCALE + "[navigation]\ntiles = 9\n")
    after = everything(report(here, "spawn-goal", [0]))
    assert {name for name in before if before[name] != after[name]} == TRAINED | EVALUATED | TABLES
    built = []

    def build(spec: WorldSpec, *_: object) -> None:
        built.append(spec)
        raise RomnavError("built")

    monkeypatch.setattr("romnav.world.build.build", build)
    trained = policy(here, "rom", 0)
    for stage in (trained, *trained.upstream):
        with pytest.raises(RomnavError, match="built"):
            stage.make(stage, Session(), lambda *_: None)
    assert built == [WorldSpec(tiles=9), WorldSpec(tiles=4)]


def test_the_arms_share_one_encoder(tmp_path: Path) -> None:
    keys = everything(report(workspace(tmp_path), "spawn-goal", [0]))
    assert len(keys) == 1 + 4 + 4 + 2 + 1
    assert len({keys[name] for name in TRAINED}) == 4


def test_an_arm_that_changes_the_encoder_gets_its_own(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("more").write_text(
        'kind = "ablation"\ntitle = "t"\n[arms.fine]\nlabel = "Fine"\nlidar.rows = 30\n'
    )
    own = policy(here, "fine", 0).upstream[0]
    assert own.folder != policy(here, "rom", 0).upstream[0].folder
    assert own.folder.parent == encoder(here, "lidar").folder.parent


def test_an_arm_without_pretraining_needs_no_encoder(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    arm = 'kind = "ablation"\ntitle = "t"\n[arms.own]\nlabel = "Own"\n'
    arm += "navigation.encoder.pretrained = false\n"
    here.project.file("more").write_text(arm)
    own = policy(here, "own", 0)
    assert own.upstream == ()
    wider = Workspace(Project(tmp_path, tmp_path / "results"), "tiny")
    wider.project.file("more").write_text(arm + "pretrain.encoder.latent = 16\npretrain.epochs = 3\n")
    assert policy(wider, "own", 0).key != own.key
    wider.project.file("more").write_text(arm + "pretrain.epochs = 3\n")
    assert policy(Workspace(Project(tmp_path, tmp_path / "results"), "tiny"), "own", 0).key == own.key


@pytest.mark.parametrize(
    ("section", "change", "rerun"),
    [
        ("quality", "images = 9", {"quality of encoder lidar", "quality of encoder depth"}),
        ("depth", "rows = 9", {"encoder depth", "quality of encoder depth"}),
        ("pretrain_depth.encoder", "latent = 9", {"encoder depth", "quality of encoder depth"}),
        ("pretrain", "epochs = 9", {"encoder lidar", "quality of encoder lidar"}),
    ],
)
def test_an_encoder_is_judged_apart_from_its_training(
    tmp_path: Path, section: str, change: str, rerun: set[str]
) -> None:
    def keys(scale: str) -> dict[str, str]:
        here = workspace(tmp_path, scale)
        return everything(quality(here, "lidar")) | everything(quality(here, "depth"))

    before, after = keys(SCALE), keys(f"{SCALE}[{section}]\n{change}\n")
    assert {name for name in before if before[name] != after[name]} == rerun


def test_seeds_are_trained_apart_and_share_the_scripted_arms(tmp_path: Path) -> None:
    names = everything(report(workspace(tmp_path), "spawn-goal", [0, 1])).keys()
    assert {"policy rom, seed 0", "policy rom, seed 1"} <= names
    assert "episodes oracle, seed 1" not in names


def test_unknown_names_are_one_clear_error(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    with pytest.raises(RomnavError, match="unknown experiment spawn-gaol; did you mean spawn-goal"):
        report(here, "spawn-gaol", [0])
    with pytest.raises(RomnavError, match="unknown arm unifrom; did you mean uniform"):
        episodes(here, "unifrom", 0)
    text = here.project.file("spawn-goal").read_text()
    here.project.file("spawn-goal").write_text(text.replace('"sr_120"', '"sr_12"'))
    fresh = Workspace(Project(tmp_path, tmp_path / "results"), "tiny")
    with pytest.raises(RomnavError, match=r"tables.spawngoal-perf-rom.columns: unknown metric sr_12; did"):
        report(fresh, "spawn-goal", [0])
    here.project.file("spawn-goal").write_text(text.replace('"paper"', '"papr"'))
    fresh = Workspace(Project(tmp_path, tmp_path / "results"), "tiny")
    with pytest.raises(RomnavError, match=r"spawn-goal.toml: published: no papr.toml; did you mean paper"):
        report(fresh, "spawn-goal", [0])


HUMANOID = """
kind = "ablation"
title = "t"
[arms.walked]
label = "RoM policy on the G1"
policy = "rom"
navigation.dynamics = "g1"
[arms.guided]
label = "Oracle on the G1"
policy = "oracle"
navigation.dynamics = "g1"
[arms.own]
label = "Trained on the G1"
navigation.dynamics = "g1"
"""


def test_a_policy_drives_another_body_without_being_trained_again(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("humanoid").write_text(HUMANOID)
    walked, own = episodes(here, "walked", 3), episodes(here, "own", 0)
    assert [stage.name for stage in walked.upstream] == [
        "locomotion", "gait library", "encoder lidar", "policy rom, seed 3"
    ]  # fmt: skip
    assert walked.upstream[-1] == policy(here, "rom", 3)
    assert walked.settings.navigation.dynamics == "g1"  # type: ignore[attr-defined]
    assert {stage.name for stage in own.upstream} == {
        "locomotion",
        "gait library",
        "encoder lidar",
        "encoder depth",
        "policy own, seed 0",
    }
    assert "locomotion" in everything(policy(here, "own", 0))
    assert "locomotion" not in everything(episodes(here, "rom", 3))
    assert [stage.name for stage in episodes(here, "guided", 3).upstream] == ["locomotion", "gait library"]
    assert episodes(here, "guided", 3).folder == episodes(here, "guided", 0).folder
    assert episodes(here, "guided", 0).key != episodes(here, "oracle", 0).key


def test_another_locomotion_policy_reruns_what_walks_on_it(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("humanoid").write_text(HUMANOID)
    before, after = (
        everything(report(workspace(tmp_path, SCALE + more), "humanoid", [0]))
        for more in ("", "[locomotion]\niterations = 9\n")
    )
    changed = {name.removesuffix(", seed 0") for name in before if before[name] != after[name]}
    walking = {"episodes walked", "episodes guided", "episodes own", "policy own"}
    assert changed == {"locomotion", "gait library", "tables humanoid"} | walking


KICKSTART = """
kind = "ablation"
title = "taught"
[arms.rom]
label = "RoM"
[arms.nav]
label = "taught"
navigation.dynamics = "g1"
kickstart.teacher = "%s"
kickstart.concentration = 20.0
[arms.nav-hum]
label = "driven"
policy = "rom"
navigation.dynamics = "g1"
"""


def test_a_teacher_is_upstream_of_its_student_with_the_same_seed(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("kickstart").write_text(KICKSTART % "rom")
    taught = policy(here, "nav", 3)
    assert policy(here, "rom", 3) in taught.upstream
    assert taught.spec["kickstart"]["concentration"] == 20.0
    assert "kickstart" not in policy(here, "rom", 3).spec
    assert episodes(here, "nav", 3).upstream[-1] == taught
    softer = workspace(tmp_path / "softer")
    softer.project.file("kickstart").write_text(KICKSTART.replace("20.0", "10.0") % "rom")
    assert policy(softer, "nav", 3).key != taught.key
    assert policy(softer, "rom", 3).key == policy(here, "rom", 3).key
    groups = waves([*taught.upstream, taught, episodes(here, "nav", 3)])
    assert [stage.name for stage in groups[-2]] == ["policy nav, seed 3"]


@pytest.mark.parametrize(
    ("teacher", "match"), [("nav-hum", "no arm nav-hum"), ("oracle", "no arm oracle"), ("nav", "has a teacher itself")]
)
def test_only_arms_trained_alone_can_teach(tmp_path: Path, teacher: str, match: str) -> None:
    here = workspace(tmp_path)
    here.project.file("kickstart").write_text(KICKSTART % teacher)
    with pytest.raises(RomnavError, match=f"arms.nav.kickstart.teacher: .*{match}"):
        policy(here, "nav", 0)


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ("navigation.env.command.forward = 0.3", r"navigation\.env\.command\.forward = 1, and its student has 0\.3"),
        ("navigation.env.max_goal_distance = 20.0", r"navigation\.env\.max_goal_distance = 30, and its student has 20"),
        ("navigation.env.period = 0.1", r"navigation\.env\.period = 0\.2, and its student has 0\.1"),
        ("navigation.policy.support = 1.2", r"navigation\.policy\.support = 1, and its student has 1\.2"),
    ],
)
def test_a_teacher_of_another_task_is_refused_before_it_is_trained(
    tmp_path: Path, change: str, difference: str
) -> None:
    here = workspace(tmp_path)
    taught = 'kickstart.teacher = "rom"'
    here.project.file("kickstart").write_text((KICKSTART % "rom").replace(taught, f"{taught}\n{change}"))
    with pytest.raises(
        RomnavError, match=rf"kickstart\.toml: arms\.nav\.kickstart\.teacher: a teacher with {difference};"
    ):
        policy(here, "nav", 0)


def test_a_body_that_is_driven_by_another_arm_takes_that_arms_period(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    odd = (KICKSTART % "rom").replace("arms.rom", "arms.odd").replace('policy = "rom"', 'policy = "odd"')
    odd = odd.replace('label = "RoM"', 'label = "Odd"\nnavigation.env.period = 0.19')
    here.project.file("kickstart").write_text(odd)
    assert episodes(here, "odd", 0)
    with pytest.raises(
        RomnavError, match=r"kickstart\.toml: arms\.nav-hum: navigation\.env\.period: 0\.19 s, no multiple"
    ):
        episodes(here, "nav-hum", 0)


def test_whatever_walks_is_made_on_the_cpu_alone(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("kickstart").write_text(KICKSTART % "rom")
    for arm, walks in {"rom": False, "nav": True, "nav-hum": True}.items():
        stages = [episodes(here, arm, 0), trials.trials(here, "safety", arm, 0), generalization(here, arm, 0)]
        if arm != "nav-hum":
            kept_one = policy(here, arm, 0).folder / "kept" / "000001.pt"
            kept_one.parent.mkdir(parents=True)
            kept_one.touch()
            stages += [policy(here, arm, 0), kept(here, arm, 0)]
        assert [stage.cpu_only for stage in stages] == [walks] * len(stages), arm
    assert policy(here, "nav-hum", 0) == policy(here, "rom", 0)
    assert not encoder(here, "depth").cpu_only
    assert navigation(here).cpu_only
    assert locomotion(here).cpu_only


def test_trials_are_on_the_body_that_the_arm_walks_on(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("kickstart").write_text(KICKSTART % "rom")
    for arm in ("nav", "nav-hum"):
        trial = trials.trials(here, "safety", arm, 0)
        assert {"locomotion", "gait library"} <= {stage.name for stage in trial.upstream}
        assert trial.settings.navigation.dynamics == "g1"  # type: ignore[attr-defined]
    assert "locomotion" not in everything(trials.trials(here, "safety", "rom", 0))
    again = workspace(tmp_path / "again")
    same_body = KICKSTART.replace('"rom"\nnavigation.dynamics = "g1"', '"rom"')
    again.project.file("kickstart").write_text(same_body % "rom")
    with pytest.raises(RomnavError, match="name rom in its place"):
        trials.trials(again, "safety", "nav-hum", 0)


def test_the_navigation_test_drives_the_rom_on_the_dev_episodes(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    test = navigation(here)
    assert test.upstream[-1].name == "policy rom, seed 0"
    assert test.upstream[-1].key == policy(here, "rom", 0).key
    assert {"locomotion", "gait library"} <= {stage.name for stage in test.upstream}
    assert [path.name for path in test.reads] == ["dev.json"]
    assert test.outputs == ("navigation.json",)


BEGIN = """
kind = "ablation"
title = "trained on"
[arms.rom]
label = "RoM"
[arms.more]
label = "on"
begin = "rom"
[arms.most]
label = "on and on"
begin = "more"
[arms.walks]
label = "driven"
policy = "more"
navigation.dynamics = "g1"
"""


def test_what_an_arm_begins_with_is_upstream_with_the_same_seed(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("on").write_text(BEGIN)
    rom, more, most = (policy(here, arm, 3) for arm in ("rom", "more", "most"))
    assert (rom in more.upstream, more in most.upstream, rom in most.upstream) == (True, True, False)
    assert more.spec["begin"] == "rom"
    assert "begin" not in rom.spec
    assert policy(here, "walks", 3) == more
    groups = waves([*rom.upstream, rom, more, most])
    assert [[stage.arm for stage in group] for group in groups[-3:]] == [["rom"], ["more"], ["most"]]


@pytest.mark.parametrize(
    ("begin", "match"),
    [
        ("walks", "arms.more.begin: no arm walks that is trained"),
        ("oracle", "arms.more.begin: no arm oracle that is trained"),
        ("more", "arms.more.begin: more begins with more"),
        ("most", "arms.most.begin: more begins with most begins with more"),
    ],
)
def test_only_trained_arms_before_it_can_be_begun_with(tmp_path: Path, begin: str, match: str) -> None:
    here = workspace(tmp_path)
    here.project.file("on").write_text(BEGIN.replace('begin = "rom"', f'begin = "{begin}"'))
    with pytest.raises(RomnavError, match=f"on.toml: {match}"):
        policy(here, "more", 0)


def test_what_an_arm_begins_with_may_be_in_a_file_that_is_refused(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    here.project.file("on").write_text(BEGIN.replace('begin = "rom"', 'begin = "base"'))
    base = '[arms.base]\nlabel = "B"\nnavigation.ppo.gamma = {}\n'
    for name, gamma in (("theirs", 0.9), ("mine", 0.8)):
        here.project.file(name).write_text(f'kind = "ablation"\ntitle = "t"\n{base.format(gamma)}')
    with pytest.raises(RomnavError, match=r"mine\.toml: arms\.base: theirs\.toml has an arm of this name with other"):
        policy(here, "more", 0)


def test_a_run_begins_with_one_policy(tmp_path: Path) -> None:
    here = workspace(tmp_path)
    text = KICKSTART.replace("concentration = 20.0", 'init = "teacher"\nbegin = "rom"')
    here.project.file("on").write_text(text % "rom")
    with pytest.raises(RomnavError, match="begin: the run cannot begin with rom and with its teacher"):
        policy(here, "nav", 0)
