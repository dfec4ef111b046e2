from __future__ import annotations

import csv
import signal
import subprocess
import sys
import textwrap
from functools import partial
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from romnav.errors import RomnavError
from romnav.navigation import checkpoint, train
from romnav.navigation.observations import PRIVILEGED_SIZE, STATE_SIZE
from romnav.navigation.ppo import make_actor
from romnav.navigation.rewards import TERMS
from romnav.navigation.spec import EncoderUseSpec, EnvSpec, NavigationSpec, PolicySpec, PPOSpec, RewardSpec
from romnav.precision import reduced_precision
from romnav.robot.gaits import GaitLibrary
from romnav.robot.humanoid import Humanoid
from romnav.robot.locomotion.train import train as train_locomotion
from romnav.robot.rom import ReducedOrderModel
from romnav.robot.spec import LocomotionSpec, PpoSpec, TaskSpec
from romnav.stopping import Stopped
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.world import World
from tests.test_journal import told

from .conftest import TOKENS, FakePerception, fake_encoder


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return checkpoint.read(folder / "policy.pt")["actor"]


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for key in a:
        assert torch.equal(a[key], b[key]), key


def test_same_spec_same_weights(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    for name in "ab":
        train.train(spec, world, perception, tmp_path / name, 1)
    assert_same(weights(tmp_path / "a"), weights(tmp_path / "b"))
    other = train.train(spec, world, perception, tmp_path / "c", 2)
    assert not torch.equal(
        checkpoint.read(other)["actor"]["attention.place"], weights(tmp_path / "a")["attention.place"]
    )


def test_the_machines_threads_do_not_matter(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    before = torch.get_num_threads()
    wide = spec.model_copy(update={"env": spec.env.model_copy(update={"envs": 96})})
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            train.train(wide, world, perception, tmp_path / str(count), 1)
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)
    assert_same(weights(tmp_path / "1"), weights(tmp_path / "2"))


def test_killed_and_resumed_equals_left_alone(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child process is killed with SIGKILL in the middle of the run; resuming gives the same weights and curve."""
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)
    train.train(spec, world, perception, tmp_path / "whole", 1)
    script = textwrap.dedent(
        f"""
        import os, signal, sys
        from pathlib import Path
        sys.path.insert(0, {str(Path(__file__).parents[2])!r})
        from tests.navigation.conftest import FakePerception
        from romnav.navigation import train
        from romnav.navigation.spec import NavigationSpec
        from romnav.world.spec import WorldSpec
        from romnav.world.build import build
        train.SAVE_EVERY = 0.0
        def progress(done, total, metric):
            if done == 3 * total // 4:
                os.kill(os.getpid(), signal.SIGKILL)
        spec = NavigationSpec.model_validate_json({spec.model_dump_json()!r})
        world = build(WorldSpec.model_validate_json({world.spec.model_dump_json()!r}))
        train.train(spec, world, FakePerception(), Path({str(tmp_path / "killed")!r}), 1, progress=progress)
        """
    )
    killed = subprocess.run([sys.executable, "-c", script])
    assert killed.returncode == -signal.SIGKILL
    assert not (tmp_path / "killed" / "policy.pt").exists()
    assert checkpoint.read(tmp_path / "killed" / "checkpoint.pt")["iterations"] == 2
    train.train(spec, world, perception, tmp_path / "killed", 1)
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "killed"))
    curves = [
        [{**row, "seconds": "", "cpu_seconds": ""} for row in csv.DictReader((tmp_path / name / "curve.csv").open())]
        for name in ("whole", "killed")
    ]
    assert curves[0] == curves[1]
    assert len(curves[0]) == spec.ppo.iterations


def test_a_run_that_begins_with_a_policy_trains_it_on(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    first = train.train(spec, world, perception, tmp_path / "first", 1)
    slow = spec.model_copy(
        update={"ppo": spec.ppo.model_copy(update={"learning_rate": 1e-9, "learning_rate_range": (1e-9, 1e-9)})}
    )
    on = train.train(slow, world, perception, tmp_path / "on", 2, begin=first)
    anew = train.train(slow, world, perception, tmp_path / "anew", 2)
    for network, name in (("actor", "attention.place"), ("critic", "mlp.0.weight")):
        given, after, other = (checkpoint.read(path)[network][name] for path in (first, on, anew))
        torch.testing.assert_close(after, given, atol=1e-6, rtol=0)
        assert not torch.allclose(after, other, atol=1e-3)
    # what is drawn in the run is not what it begins with
    spawned = [next(csv.DictReader((path.with_name("curve.csv")).open())) for path in (on, anew)]
    assert spawned[0]["episodes"] == spawned[1]["episodes"]


def test_a_run_that_begins_with_a_policy_resumes_exactly(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    first = train.train(spec, world, perception, tmp_path / "first", 1)

    def stop(done: int, total: int, metric: str) -> None:
        if done == total // 2:
            signal.raise_signal(signal.SIGTERM)

    train.train(spec, world, perception, tmp_path / "whole", 2, begin=first)
    with pytest.raises(Stopped):
        train.train(spec, world, perception, tmp_path / "half", 2, begin=first, progress=stop)
    with pytest.raises(RomnavError, match="another begin"):
        train.train(spec, world, perception, tmp_path / "half", 2)
    with pytest.raises(RomnavError, match="another begin"):
        train.train(spec, world, perception, tmp_path / "half", 2, begin=tmp_path / "whole" / "policy.pt")
    train.train(spec, world, perception, tmp_path / "half", 2, begin=first)
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "half"))


def test_a_policy_to_begin_with_has_to_fit(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    first = train.train(spec, world, perception, tmp_path / "first", 1)
    wider = spec.model_copy(update={"policy": spec.policy.model_copy(update={"critic": (8, 8)})})
    guided = spec.model_copy(update={"ppo": spec.ppo.model_copy(update={"guidance": 0.5})})
    for other in (wider, guided):
        with pytest.raises(RomnavError, match="needs the same networks and senses"):
            train.train(other, world, perception, tmp_path / "other", 1, begin=first)
    with pytest.raises(RomnavError, match="no such policy"):
        train.train(spec, world, perception, tmp_path / "other", 1, begin=tmp_path / "none.pt")
    content = checkpoint.read(first)
    del content["critic"]
    checkpoint.save(tmp_path / "actor.pt", content)
    with pytest.raises(RomnavError, match="has no critic to begin with; train that arm again, or be taught by it"):
        train.train(spec, world, perception, tmp_path / "other", 1, begin=tmp_path / "actor.pt")


def averaging(spec: NavigationSpec, share: float) -> NavigationSpec:
    return spec.model_copy(update={"ppo": spec.ppo.model_copy(update={"average": share, "keep": 1})})


def test_what_is_saved_is_the_average_of_the_weights(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    train.train(averaging(spec, 0.0), world, perception, tmp_path / "last", 1)
    train.train(averaging(spec, 1.0), world, perception, tmp_path / "mean", 1)
    last, mean = (sorted((tmp_path / name / "kept").glob("*.pt")) for name in ("last", "mean"))
    walked = [checkpoint.read(path)["actor"] for path in last]
    for k, path in enumerate(mean):
        for name, value in checkpoint.read(path)["actor"].items():
            if value.is_floating_point():
                expected = torch.stack([weights[name] for weights in walked[: k + 1]]).double().mean(0)
                torch.testing.assert_close(value.double(), expected, atol=1e-5, rtol=1e-4)
    assert_same(weights(tmp_path / "mean"), checkpoint.read(mean[-1])["actor"])
    # what is saved has no part in the run
    assert_same(checkpoint.read(mean[-1])["critic"], checkpoint.read(last[-1])["critic"])


def test_an_averaging_run_resumes_exactly(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    thawing = unfreezing(averaging(spec, 0.5), 0.5)

    def stop(done: int, total: int, metric: str) -> None:
        if done == total // 2:
            signal.raise_signal(signal.SIGTERM)

    train.train(thawing, world, perception, tmp_path / "whole", 1)
    with pytest.raises(Stopped):
        train.train(thawing, world, perception, tmp_path / "half", 1, progress=stop)
    train.train(thawing, world, perception, tmp_path / "half", 1)
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "half"))
    assert any(name.startswith("encoder.") for name in weights(tmp_path / "half"))


def unfreezing(spec: NavigationSpec, share: float) -> NavigationSpec:
    return spec.model_copy(update={"encoder": EncoderUseSpec(unfreeze_at=share)})


def test_the_encoder_is_trained_from_its_iteration_on(world: World, spec: NavigationSpec, tmp_path: Path) -> None:
    """Until then the run is that of the frozen arm, bit for bit, and keeps no images."""
    perception = FakePerception()
    kept = []

    def progress(done: int, total: int, metric: str) -> None:
        kept.append(perception.images)

    train.train(spec, world, FakePerception(), tmp_path / "frozen", 1)
    train.train(unfreezing(spec, 0.5), world, perception, tmp_path / "own", 1, progress=progress)
    assert kept == [False, False, True, True]
    frozen, own = (
        [{**row, "seconds": "", "cpu_seconds": ""} for row in csv.DictReader((tmp_path / name / "curve.csv").open())]
        for name in ("frozen", "own")
    )
    assert frozen[:2] == own[:2]
    assert frozen[3] != own[3]
    found = {k: v for k, v in weights(tmp_path / "own").items() if k.startswith("encoder.")}
    before = fake_encoder().state_dict()
    changed = {k for k in before if not torch.equal(before[k], found[f"encoder.{k}"])}
    assert changed == {f"{part}.{kind}" for part in ("trunk.0", "mean") for kind in ("weight", "bias")}
    assert perception.encoder.digest() == fake_encoder().digest()
    assert not any(k.startswith("encoder.") for k in weights(tmp_path / "frozen"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_saves_first_and_the_run_goes_on_from_there(
    world: World, spec: NavigationSpec, tmp_path: Path, number: signal.Signals
) -> None:
    def progress(done: int, total: int, metric: str) -> None:
        if done == total // 2:
            signal.raise_signal(number)

    with pytest.raises(Stopped):
        train.train(spec, world, FakePerception(), tmp_path, 1, progress=progress)
    assert checkpoint.read(tmp_path / "checkpoint.pt")["iterations"] == spec.ppo.iterations // 2
    seen: list[int] = []
    train.train(spec, world, FakePerception(), tmp_path, 1, progress=lambda done, total, metric: seen.append(done))
    assert len(seen) == spec.ppo.iterations // 2


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.75], ids=["from the start", "before", "at", "after the stop"])
def test_resuming_across_the_switch_is_exact(
    share: float, world: World, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)
    spec = unfreezing(spec, share)

    class Stop(Exception):
        pass

    def stop(done: int, total: int, metric: str) -> None:
        if done == 3 * total // 4:
            raise Stop

    train.train(spec, world, FakePerception(), tmp_path / "whole", 1)
    with pytest.raises(Stop):
        train.train(spec, world, FakePerception(), tmp_path / "stopped", 1, progress=stop)
    assert checkpoint.read(tmp_path / "stopped" / "checkpoint.pt")["iterations"] == 2
    train.train(spec, world, FakePerception(), tmp_path / "stopped", 1)
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "stopped"))


def test_a_policy_with_its_own_encoder_carries_and_uses_it(world: World, spec: NavigationSpec, tmp_path: Path) -> None:
    perception = FakePerception()
    path = train.train(unfreezing(spec, 0.0), world, perception, tmp_path, 1)
    actor = checkpoint.load_actor(path, perception.encoder)
    assert actor.encoder is not None
    assert_same(dict(actor.state_dict()), weights(tmp_path))
    perception.images = True
    torch.manual_seed(0)
    robots = ReducedOrderModel(world, 5, spec.env.period)
    robots.position, robots.yaw = torch.rand(5, 3), torch.rand(5)
    images, state = perception(robots, torch.zeros(5, 2))["lidar"], torch.rand(5, STATE_SIZE)
    mine = actor(TensorDict({"lidar": images, "state": state}, batch_size=[5]))
    template = TensorDict({"lidar": torch.zeros(1, *TOKENS), "state": state[:1]}, batch_size=[1])
    frozen = make_actor(template, spec.policy)
    frozen.load_state_dict({k: v for k, v in weights(tmp_path).items() if not k.startswith("encoder.")})
    with torch.no_grad(), reduced_precision(images.device):
        seen = {"own": actor.encoder(images.float()), "pretrained": perception.encoder(images.float())}
    obs = {name: TensorDict({"lidar": tokens, "state": state}, batch_size=[5]) for name, tokens in seen.items()}
    torch.testing.assert_close(frozen(obs["own"]), mine)
    frozen.reset()
    assert not torch.allclose(frozen(obs["pretrained"]), mine, atol=1e-4)


def test_policies_on_the_way_are_kept(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    """The one kept after two iterations is the policy of a run of two; the last is the run's own."""

    unscheduled = spec.env.model_copy(update={"reward": RewardSpec(action_rate=(-0.01, -0.01))})

    def run(name: str, **changes: int) -> Path:
        ppo = spec.ppo.model_copy(update=changes)
        train.train(spec.model_copy(update={"env": unscheduled, "ppo": ppo}), world, perception, tmp_path / name, 1)
        return tmp_path / name

    long, short = run("long", iterations=4, keep=2), run("short", iterations=2)
    assert sorted(file.name for file in (long / "kept").iterdir()) == ["000002.pt", "000004.pt"]
    kept = [checkpoint.read(long / "kept" / name) for name in ("000002.pt", "000004.pt")]
    assert_same(kept[0]["actor"], weights(short))
    assert_same(kept[1]["actor"], weights(long))
    assert kept[0]["steps"] * 2 == kept[1]["steps"]
    assert not (short / "kept").exists()


def test_learning_rate_stays_in_bounds(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    low, high = spec.ppo.learning_rate_range
    tight = spec.model_copy(update={"ppo": spec.ppo.model_copy(update={"desired_kl": 1e-9, "iterations": 6})})
    train.train(tight, world, perception, tmp_path, 1)
    rates = [float(row["learning_rate"]) for row in csv.DictReader((tmp_path / "curve.csv").open())]
    assert rates[-1] == low
    assert all(low <= rate <= high for rate in rates)


def test_what_is_not_finite_stops_the_run_and_is_not_saved(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)
    broken = spec.model_copy(update={"ppo": spec.ppo.model_copy(update={"gamma": float("nan")})})
    with pytest.raises(RomnavError, match=r"iteration 1: .* not finite"):
        train.train(broken, world, perception, tmp_path, 1)
    assert not list(tmp_path.glob("*.pt"))


def test_a_longer_run_switches_where_the_shorter_one_does(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[float] = []
    row = train._row
    monkeypatch.setattr(train, "_row", lambda *a: seen.append(a[4].progress) or row(*a))
    twice = spec.model_copy(update={"ppo": spec.ppo.model_copy(update={"iterations": 2, "stages": 2})})
    train.train(twice, world, perception, tmp_path, 1)
    assert seen == [0.0, 0.5, 1.0, 1.5]


def test_learning_raises_the_return(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    """Paid for steady commands alone, the policy becomes steady: the sign of every gradient is right."""
    terms = {name: 0.0 for name in RewardSpec.model_fields if name in TERMS}
    reward = RewardSpec(**(terms | {"action_rate": (-1.0, -1.0)}))
    learner = spec.model_copy(
        update={
            "env": spec.env.model_copy(update={"envs": 48, "reward": reward}),
            "ppo": spec.ppo.model_copy(update={"iterations": 10, "steps": 12, "epochs": 4, "gamma": 0.9}),
        }
    )
    train.train(learner, world, perception, tmp_path, 1)
    rows = list(csv.DictReader((tmp_path / "curve.csv").open()))
    assert float(rows[-1]["reward_action_rate"]) > 0.7 * float(rows[0]["reward_action_rate"])


def test_checkpoint_of_another_run_is_refused(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)

    class Stop(Exception):
        pass

    def stop(done: int, total: int, metric: str) -> None:
        if done == total // 2:
            raise Stop

    with pytest.raises(Stop):
        train.train(spec, world, perception, tmp_path, 1, progress=stop)
    with pytest.raises(RomnavError, match=r"checkpoint\.pt: belongs to a run with another seed; delete it"):
        train.train(spec, world, perception, tmp_path, 2)
    train.train(spec, world, perception, tmp_path, 2, resume=False)


def test_policy_errors_name_file_and_fix(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    path = train.train(spec, world, perception, tmp_path, 1)
    encoder, other = fake_encoder(), fake_encoder(latent=9)
    assert checkpoint.load_actor(path, encoder)
    digests = f"{encoder.digest()}, but the encoder at hand is {other.digest()}"
    with pytest.raises(RomnavError, match=f"key 'encoder' is {digests}; train the arm again"):
        checkpoint.load_actor(path, other)
    checkpoint.save(tmp_path / "renamed.pt", {**checkpoint.read(path), "encoder": other.digest()})
    with pytest.raises(RomnavError, match=r"renamed\.pt: a policy of another architecture .*attention\.embed"):
        checkpoint.load_actor(tmp_path / "renamed.pt", other)
    broken = checkpoint.read(path)
    broken["actor"]["state_embedding.0.weight"][0] = torch.inf
    checkpoint.save(tmp_path / "broken.pt", broken)
    with pytest.raises(RomnavError, match=r"broken\.pt: state_embedding\.0\.weight not finite"):
        checkpoint.load_actor(tmp_path / "broken.pt", encoder)
    with pytest.raises(RomnavError, match=r"none\.pt: no such policy; train the arm"):
        checkpoint.read(tmp_path / "none.pt")
    content = path.read_bytes()
    for cut in (0, 10, len(content) // 2, len(content) - 1):
        torn = tmp_path / "torn.pt"
        torn.write_bytes(content[:cut])
        with pytest.raises(RomnavError, match=r"torn\.pt: damaged, or no policy"):
            checkpoint.read(torn)
    torch.save({"weights": 1}, tmp_path / "foreign.pt")
    with pytest.raises(RomnavError, match="key 'format' is not"):
        checkpoint.read(tmp_path / "foreign.pt")


@pytest.mark.parametrize("library", [None, "results/cpu/locomotion/gaits.pt"], ids=["standing", "walking"])
def test_a_run_on_the_humanoid_resumes_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str | None
) -> None:
    """Stopped after half of its iterations: the robots walk on from where they were."""
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)
    world = build(WorldSpec(tiles=2, seed=5, goals_per_tile=4))
    tiny = LocomotionSpec(
        task=TaskSpec(robots=4, shares={"flat": 1.0}), ppo=PpoSpec(steps=2, epochs=1, minibatches=1), iterations=1
    )
    walk = train_locomotion(tiny, tmp_path, threads=1)
    gaits = GaitLibrary.load(Path(__file__).parents[2] / library) if library else GaitLibrary([])
    body = partial(Humanoid, checkpoint=walk, gaits=gaits, threads=1)
    spec = NavigationSpec(
        dynamics="g1",
        env=EnvSpec(envs=3, duration=2.0, sampler=SamplerSpec(stair_probability=1.0)),
        policy=PolicySpec(attention=16, heads=2, queries=2, recurrent=16, hidden=16, critic=(16,)),
        ppo=PPOSpec(iterations=2, steps=6, epochs=1, minibatches=3),
    )

    class Stop(Exception):
        pass

    def late(done: int, total: int, metric: str) -> None:
        if done == total:
            raise Stop

    train.train(spec, world, FakePerception(), tmp_path / "whole", 1, body=body)
    with pytest.raises(Stop):
        train.train(spec, world, FakePerception(), tmp_path / "half", 1, body=body, progress=late)
    assert checkpoint.read(tmp_path / "half" / "checkpoint.pt")["iterations"] == 1
    train.train(spec, world, FakePerception(), tmp_path / "half", 1, body=body)
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "half"))


def test_a_training_tells_its_curve(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    train.train(spec, world, perception, tmp_path, 0)
    with (tmp_path / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    seen = told(tmp_path)
    for tag, column in {
        "reward/collision": "reward_collision",
        "loss/value": "loss_value",
        "run/seconds": "seconds",
    }.items():
        curve = [(int(r["steps"]), float(r[column])) for r in rows]
        assert [step for step, _ in seen[tag]] == [step for step, _ in curve]
        assert [value for _, value in seen[tag]] == pytest.approx([value for _, value in curve], rel=1e-4)


def test_a_policys_file_has_its_critic(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    path = train.train(spec, world, perception, tmp_path, 0)
    critic = checkpoint.load_critic(path)
    assert critic is not None
    seen = TensorDict({"critic": torch.rand(5, STATE_SIZE + PRIVILEGED_SIZE)}, batch_size=[5])
    assert critic(seen).unique().shape == (5,)
    content = checkpoint.read(path)
    checkpoint.save(path, {**content, "critic": {**content["critic"], "mlp.0.bias": torch.zeros(3)}})
    with pytest.raises(RomnavError, match=r"policy\.pt: key 'critic' .*train the arm again"):
        checkpoint.load_critic(path)
    checkpoint.save(path, {name: value for name, value in content.items() if name != "critic"})
    assert checkpoint.load_critic(path) is None
