from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from romnav.config import Config
from romnav.errors import RomnavError
from romnav.experiment.project import Project
from romnav.experiment.scales import ScaleFile
from romnav.experiment.spec import Experiment, load_experiments, parse, suggest
from romnav.navigation.spec import KickstartSpec

ROOT = Path(__file__).parents[2]
EXPERIMENT = """
kind = "ablation"
title = "t"
[arms.rom]
label = "RoM"
[arms.slow]
label = "Slow"
navigation.env.command.forward = 0.5
"""


def fault(folder: Path, name: str) -> str:
    """What is wrong with an experiment; the only one of the folder that there is something wrong with."""
    experiments, faults = load_experiments(folder)
    assert name not in experiments
    (message,) = (str(error) for error in faults.values())
    assert "\n" not in message
    return message


class Inner(Config):
    width: int = 1
    span: tuple[float, float] = (0.0, 1.0)


class Outer(Config):
    inner: Inner = Inner()
    optional: Inner | None = None
    rate: float = 1.0


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"inner": {"widht": 2}}, "f.toml: unknown key inner.widht; did you mean width?"),
        ({"optional": {"spam": 2}}, "f.toml: unknown key optional.spam; did you mean span?"),
        ({"raet": 2.0}, "f.toml: unknown key raet; did you mean rate?"),
        ({"zzz": 2.0}, "f.toml: unknown key zzz; there are inner, optional, rate"),
        ({"rate": "fast"}, "f.toml: key rate: input should be a valid number, not 'fast'"),
        ({"rate": "1.5"}, "f.toml: key rate: input should be a valid number, not '1.5'"),
        ({"inner": {"width": 1.5}}, "f.toml: key inner.width: input should be a valid integer"),
        ({"inner": {"span": [0, "x"]}}, "f.toml: key inner.span.1: input should be a valid number, not 'x'"),
        ({"inner": 3}, "f.toml: key inner: input should be an object, not 3"),
    ],
)
def test_an_error_names_file_key_and_nearest_name(data: dict, message: str) -> None:
    with pytest.raises(RomnavError) as error:
        parse(Outer, data, Path("f.toml"))
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_toml_arrays_and_integers_become_tuples_and_floats() -> None:
    outer = parse(Outer, {"rate": 2, "inner": {"span": [1, 2]}}, Path("f.toml"))
    assert outer.rate == 2.0
    assert outer.inner.span == (1.0, 2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kind = ", "not valid TOML: Invalid value (at end of document)"),
        (EXPERIMENT.replace('title = "t"\n', ""), "key title is missing"),
        (
            EXPERIMENT.replace("ablation", "ablatoin"),
            "key kind: input should be 'ablation', 'safety' or 'deploy', not 'ablatoin'",
        ),
        (EXPERIMENT.replace("arms.slow", "arms.oracle"), "arms: oracle cannot be the name of a trained arm"),
        (EXPERIMENT.replace('label = "RoM"', ""), "key arms.rom.label is missing"),
        (
            EXPERIMENT.replace('"RoM"', '"R\\nM"'),
            "arms.rom.label: 'R\\nM' is no label; use one line of 1 to 80 characters",
        ),
        ("seeds = []\n" + EXPERIMENT, "key seeds: tuple should have at least 1 item after validation, not 0, not []"),
        ("seeds = [1, 1]\n" + EXPERIMENT, "seeds: 1 is there twice; name it once"),
        ("seeds = [-1]\n" + EXPERIMENT, "key seeds.0: input should be greater than or equal to 0, not -1"),
        (EXPERIMENT.split("[arms")[0] + "[arms]\n", "key arms: dictionary should have at least 1 item after"),
    ],
)
def test_an_invalid_experiment_is_one_clear_error(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "e.toml"
    file.write_text(text)
    assert fault(tmp_path, "e").startswith(f"{file}: {message}")


PLACE = "belongs at the top of the file, above every [arms...] and [tables...]"


@pytest.mark.parametrize(
    ("table", "key"),
    [
        *(
            ("", f"arms.slow.{line}")
            for line in (
                "seeds = [0, 1]",
                'published = "paper"',
                'reference = "rom"',
                'kind = "ablation"',
                'title = "t"',
            )
        ),
        ("", "arms.slow.scales.smoke.lidar.rows = 3"),
        ("", "arms.slow.tables.x = {}"),
        ('[arms.driven]\nlabel = "D"\npolicy = "rom"\n', "arms.driven.seeds = [0, 1]"),
        ("[tables.x]\n", "tables.x.seeds = [0, 1]"),
        ("[tables.x]\n", 'tables.x.title = "t"'),
        ("[scales.smoke]\n", "scales.smoke.seeds = [0, 1]"),
    ],
)
def test_a_key_appended_to_the_file_is_told_its_place(tmp_path: Path, table: str, key: str) -> None:
    file = tmp_path / "e.toml"
    section, name, line = key.split(".", 2)
    appended = re.split(r"[. ]", line)[0]
    head = "".join(row for row in EXPERIMENT.splitlines(True) if not row.startswith(appended))
    file.write_text(f"{head}{table}{line}\n")
    assert fault(tmp_path, "e") == f"{file}: unknown key {section}.{name}.{appended}; {appended} {PLACE}"


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ('[tables.x]\nkin = "contrasts"', "unknown key tables.x.kin; did you mean kind?"),
        ('[tables.x]\nrows = ["rmo"]', "tables.x: no arm rmo; did you mean rom?"),
        ('[tables.x]\nkind = "trials"', "tables.x.kind: trials is no table of an experiment of kind ablation"),
        ('[tables.x]\nkind = "curves"\nrows = ["rom"]', "tables.x: a table of kind curves has no rows to choose"),
        (
            '[tables."a/b"]',
            "tables.a/b: 'a/b' names no file; use up to 64 letters, digits and . _ + -, a letter or digit first",
        ),
        ('[tables.x]\ncolumns = [{ header = "H" }]', "key tables.x.columns.0.metric is missing"),
    ],
)
def test_an_invalid_table_is_one_clear_error(tmp_path: Path, tables: str, message: str) -> None:
    file = tmp_path / "e.toml"
    file.write_text(f"{EXPERIMENT}{tables}\n")
    assert fault(tmp_path, "e") == f"{file}: {message}"


def clash(folder: Path, key: str, what: str) -> None:
    """Checks that a.toml and b.toml are refused for a name that they share, and c.toml, which shares none, is not."""
    (folder / "c.toml").write_text('kind = "ablation"\ntitle = "t"\n[arms.other]\nlabel = "Other"\n')
    experiments, faults = load_experiments(folder)
    assert set(experiments) == {"c"}
    assert {name: str(error) for name, error in faults.items()} == {
        name: f"{folder / name}.toml: {key}: {other}.toml has {what}; rename it in the newer of the two files"
        for name, other in (("a", "b"), ("b", "a"))
    }


def test_a_table_has_one_experiment(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.toml").write_text(f"{EXPERIMENT}[tables.mine]\n")
    clash(tmp_path, "tables.mine", "a table of this name, too")


def test_an_arm_of_two_experiments_is_the_same_arm(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(EXPERIMENT)
    (tmp_path / "b.toml").write_text(EXPERIMENT.replace('"Slow"', '"Slower label"'))
    assert set(load_experiments(tmp_path)[0]) == {"a", "b"}
    (tmp_path / "b.toml").write_text(EXPERIMENT + "[scales.smoke.lidar]\nrows = 3\n")
    (tmp_path / "scales").mkdir()
    (tmp_path / "scales" / "smoke.toml").touch()
    clash(tmp_path, "arms.rom", "an arm of this name with other settings")
    guarded = '[arms.guarded]\nlabel = "G"\npolicy = "rom"\n'
    for here, there in (("0.5", "0.6"), ("filter = true", ""), ('policy = "rom"', 'policy = "slow"')):
        text = EXPERIMENT + guarded + "filter = true\n"
        (tmp_path / "a.toml").write_text(text)
        (tmp_path / "b.toml").write_text(text.replace(here, there))
        arm = "slow" if here == "0.5" else "guarded"
        clash(tmp_path, f"arms.{arm}", "an arm of this name with other settings")


def test_the_filter_guards_who_drives_the_policy_of_another(tmp_path: Path) -> None:
    file = tmp_path / "e.toml"
    file.write_text(EXPERIMENT.replace('label = "RoM"', 'label = "RoM"\nfilter = true'))
    assert 'arms: rom.filter: policies are trained without it; give another arm policy = "rom"' in fault(tmp_path, "e")


def test_suggest_lists_all_names_where_none_is_near() -> None:
    assert suggest("x", []) == "; there are none"
    assert suggest("smok", ["cpu", "smoke"]) == "; did you mean smoke?"


@pytest.fixture
def scales(tmp_path: Path) -> Path:
    (tmp_path / "smoke.toml").write_text("[lidar]\nrows = 15\n[navigation.env]\nenvs = 8\nduration = 20.0\n")
    return tmp_path


def test_an_arm_changes_only_what_it_names(scales: Path) -> None:
    scale = ScaleFile(scales, "smoke")
    experiment = parse(Experiment, tomllib.loads(EXPERIMENT), Path("e.toml"))
    changed = scale.changed("slow", experiment, Path("e.toml"))
    assert changed.navigation.env.command.forward == 0.5
    assert changed.navigation.env.envs == 8
    expected = scale.settings.model_dump()
    expected["navigation"]["env"]["command"]["forward"] = 0.5
    assert changed.model_dump() == expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("navigation.env.envz = 3", "unknown key arms.slow.navigation.env.envz; did you mean envs?"),
        ("navigaton.env.envs = 3", "unknown key arms.slow.navigaton; did you mean navigation?"),
        ('navigation.env.envs = "3"', "key arms.slow.navigation.env.envs: input should be a valid integer"),
        ("[arms.slow.navigation.env]\nseeds = [0]", f"unknown key arms.slow.navigation.env.seeds; seeds {PLACE}"),
        ("navigation = 3", "key arms.slow.navigation: input should be an object, not 3"),
        ("evaluation.duration = 60.0", "arms.slow.evaluation: set [evaluation] of the scale, all arms share it"),
    ],
)
def test_a_wrong_change_names_the_experiment_file(scales: Path, change: str, message: str) -> None:
    text = EXPERIMENT.replace("navigation.env.command.forward = 0.5", change)
    experiment = parse(Experiment, tomllib.loads(text), Path("e.toml"))
    with pytest.raises(RomnavError) as error:
        ScaleFile(scales, "smoke").changed("slow", experiment, Path("e.toml"))
    assert str(error.value).startswith(f"e.toml: {message}")


def test_all_arms_change_together_at_one_scale(scales: Path) -> None:
    text = EXPERIMENT + "[scales.smoke.navigation]\nenv.envs = 9\nenv.command.forward = 0.75\n"
    text += "[scales.cpu.lidar]\nrows = 20\n"
    experiment = parse(Experiment, tomllib.loads(text), Path("e.toml"))
    scale = ScaleFile(scales, "smoke")
    found = {name: scale.changed(name, experiment, Path("e.toml")) for name in experiment.arms}
    assert {name: s.navigation.env.envs for name, s in found.items()} == {"rom": 9, "slow": 9}
    assert {name: s.navigation.env.command.forward for name, s in found.items()} == {"rom": 0.75, "slow": 0.5}
    assert found["rom"].lidar.rows == 15
    wrong = parse(Experiment, tomllib.loads(text.replace("envs", "envz")), Path("e.toml"))
    with pytest.raises(RomnavError, match=r"unknown key scales\.smoke\.navigation\.env\.envz; did you mean envs"):
        scale.changed("rom", wrong, Path("e.toml"))


BODIES = """
[bodies.g1.navigation]
env.envs = 9
env.command.forward = 0.75
ppo.iterations = 3
stair_limits = [0.4, 0.5]
"""


def test_an_arm_on_another_body_begins_with_the_settings_of_that_body(scales: Path) -> None:
    plain = ScaleFile(scales, "smoke")
    file = scales / "smoke.toml"
    file.write_text(file.read_text() + BODIES)
    scale = ScaleFile(scales, "smoke")
    text = EXPERIMENT.replace("[arms.slow]", '[arms.hum]\nlabel = "H"\nnavigation.dynamics = "g1"\n[arms.slow]')
    text = text.replace("forward = 0.5", 'forward = 0.5\nnavigation.dynamics = "g1"')
    experiment = parse(Experiment, tomllib.loads(text), Path("e.toml"))
    found = {name: scale.changed(name, experiment, Path("e.toml")).navigation for name in experiment.arms}
    assert found["rom"] == plain.settings.navigation == scale.settings.navigation
    assert (found["hum"].env.envs, found["hum"].ppo.iterations, found["hum"].env.command.forward) == (9, 3, 0.75)
    assert found["hum"].env.duration == 20.0  # the scale's
    assert scale.of_body("g1").navigation == found["hum"]
    assert scale.of_body("rom").navigation == scale.settings.navigation
    assert scale.settings.on_body(found["hum"]).navigation.stair_limits == (0.4, 0.5)
    assert (found["slow"].env.envs, found["slow"].env.command.forward) == (9, 0.5)  # the arm's own change comes last
    at_scale = parse(Experiment, tomllib.loads(text + "[scales.smoke.navigation.env]\nenvs = 10\n"), Path("e.toml"))
    assert scale.changed("hum", at_scale, Path("e.toml")).navigation.env.envs == 10


def test_how_a_body_is_taught_is_for_arms_with_a_teacher(scales: Path) -> None:
    file = scales / "smoke.toml"
    file.write_text(file.read_text() + BODIES + '[bodies.g1.kickstart]\ninit = "teacher"\ncritic_first = 0.1\n')
    taught = (
        '[arms.{}]\nlabel = "T"\nnavigation.dynamics = "{}"\nkickstart.teacher = "rom"\nkickstart.critic_first = 0.2\n'
    )
    text = EXPERIMENT.replace("forward = 0.5", 'forward = 0.5\nnavigation.dynamics = "g1"')
    text += taught.format("nav", "g1") + taught.format("light", "rom")
    experiment = parse(Experiment, tomllib.loads(text), Path("e.toml"))
    scale = ScaleFile(scales, "smoke")
    found = {name: scale.changed(name, experiment, Path("e.toml")).kickstart for name in experiment.arms}
    assert found["rom"] is found["slow"] is None
    assert found["nav"] == KickstartSpec(teacher="rom", init="teacher", critic_first=0.2)
    assert found["light"] == KickstartSpec(teacher="rom", critic_first=0.2)


def test_a_scale_of_one_body_has_its_settings(scales: Path) -> None:
    (scales / "smoke.toml").write_text('navigation.dynamics = "g1"\n' + BODIES)
    assert ScaleFile(scales, "smoke").settings.navigation.env.envs == 9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("[bodies.g1.navigation.ppo]\niteration = 3", "unknown key bodies.g1.navigation.ppo.iteration; did you mean"),
        ("[bodies.g1.navigation.env]\nenvs = 0", "key bodies.g1.navigation.env.envs: input should be greater"),
        ("[bodies.g1.navigation.env]\nenvs = 4", "bodies.g1.navigation: ppo.minibatches: 8 of 4 environments"),
        ("[bodies.g1.evaluation]\nduration = 9.0", "bodies.g1.evaluation: set [evaluation] of the scale"),
        ('[bodies.g1.navigation]\ndynamics = "rom"', "bodies.g1.navigation.dynamics: it is g1 here; leave it out"),
        ("[bodies.g1]\nnavigation = 3", "key bodies.g1.navigation: input should be an object, not 3"),
        ('[bodies.g1.kickstart]\ninit = "old"', "key bodies.g1.kickstart.init: input should be 'fresh' or 'teacher'"),
        ("[bodies]\ng1 = 3", "key bodies.g1: input should be an object, not 3"),
        ("[bodies.g2.lidar]\nrows = 3", "bodies.g2"),
        ("[tables.x]", "unknown key tables; there are begin, bodies,"),
        ("[bodys.g1.lidar]\nrows = 3", "unknown key bodys; did you mean bodies?"),
    ],
)
def test_a_wrong_setting_of_a_body_names_the_scale(scales: Path, change: str, message: str) -> None:
    file = scales / "smoke.toml"
    file.write_text(file.read_text() + change)
    with pytest.raises(RomnavError) as error:
        ScaleFile(scales, "smoke")
    assert str(error.value).startswith(f"{file}: {message}")
    assert "\n" not in str(error.value)


def test_an_experiment_names_only_scales_that_there_are(tmp_path: Path) -> None:
    (tmp_path / "scales").mkdir()
    (tmp_path / "scales" / "smoke.toml").write_text("")
    (tmp_path / "e.toml").write_text(EXPERIMENT + "[scales.smok.lidar]\nrows = 3\n")
    assert fault(tmp_path, "e").endswith("e.toml: scales: unknown scale smok; did you mean smoke?")


def test_an_unknown_scale_names_the_nearest(scales: Path) -> None:
    with pytest.raises(RomnavError, match="unknown scale smok; did you mean smoke"):
        ScaleFile(scales, "smok")


def test_the_projects_own_experiments_are_valid_at_every_scale() -> None:
    project = Project(ROOT, ROOT / "results")
    files = sorted((ROOT / "experiments" / "scales").glob("*.toml"))
    assert {file.stem for file in files} == {"smoke", "cpu", "paper"}
    for file in files:
        scale = ScaleFile(file.parent, file.stem)
        for name, experiment in project.experiments.items():
            assert [scale.changed(arm, experiment, project.file(name)) for arm in experiment.arms]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('policy = "rmo"', "arms.slow.policy: no arm rmo that is trained; did you mean rom"),
        ('policy = "slow"', "arms.slow.policy: no arm slow that is trained"),
        ('policy = "rom"\nnavigation.ppo.gamma = 0.5', "can only change navigation.dynamics"),
        ('policy = "rom"\nworld.tiles = 3', "can only change navigation.dynamics"),
        ('policy = "rom"\nnavigation = 3', "can only change navigation.dynamics"),
    ],
)
def test_an_arm_that_drives_another_ones_policy(tmp_path: Path, change: str, message: str) -> None:
    text = EXPERIMENT.replace("navigation.env.command.forward = 0.5", change)
    (tmp_path / "a.toml").write_text(text)
    assert message in fault(tmp_path, "a")


@pytest.mark.parametrize("name", ["..", "/abs/x", "a/b", "", ".hidden", "-x", "a" * 300, "ro m", "naïve"])
def test_an_arm_is_named_so_that_its_folder_lies_among_the_results(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.toml").write_text(EXPERIMENT.replace("[arms.slow]", f'[arms."{name}"]'))
    assert "names no file; use up to 64 letters" in fault(tmp_path, "a")


def test_a_byte_order_mark_is_no_mistake(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(EXPERIMENT, "utf-8-sig")
    assert set(load_experiments(tmp_path)[0]) == {"a"}


def test_one_broken_file_leaves_the_others(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("kind = ")
    (tmp_path / "b.toml").write_text(EXPERIMENT)
    (tmp_path / "c.toml").write_text(EXPERIMENT.replace("[arms.rom]", '[arms.other]\npolicy = "in-a"'))
    experiments, faults = load_experiments(tmp_path)
    assert set(experiments) == {"b", "c"}
    assert set(faults) == {"a"}


@pytest.mark.parametrize("name", ["../scales/tiny", "..", "", "smoke.toml", "/etc"])
def test_a_scale_is_a_name_and_no_path(tmp_path: Path, name: str) -> None:
    (tmp_path / "scales").mkdir()
    for stem in ("smoke", "tiny"):
        (tmp_path / "scales" / f"{stem}.toml").write_text("")
    with pytest.raises(RomnavError, match="unknown scale"):
        ScaleFile(tmp_path / "scales", name)
