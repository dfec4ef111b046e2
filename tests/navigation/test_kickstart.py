from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.distributions import Beta, kl_divergence

from romnav.errors import RomnavError
from romnav.navigation import checkpoint, train
from romnav.navigation.env import NavigationEnv
from romnav.navigation.kickstart import KickstartedPPO, Teacher, beta_divergence, blank_lesson, bounded, inherit
from romnav.navigation.observations import observe
from romnav.navigation.ppo import make_actor, make_ppo
from romnav.navigation.spec import EncoderUseSpec, KickstartSpec, NavigationSpec, Schedule
from romnav.robot.rom import ReducedOrderModel
from romnav.world.world import LEVEL_GAP, World

from .conftest import TOKENS, FakePerception, fake_encoder

SPEC = KickstartSpec(teacher="rom")
parameters = st.floats(1.0, 300.0)


class Feeling(ReducedOrderModel):
    """A reduced-order model with proprioception."""

    @property
    def proprioception(self) -> torch.Tensor:
        return torch.stack([self.yaw.sin(), self.yaw.cos(), self.contacts], dim=1)


class WithCamera(FakePerception):
    """A second sensor beside the LiDAR, as a humanoid has."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = type("Eye", (), {"encoder": fake_encoder()})()

    def __call__(self, robot: ReducedOrderModel, counters: torch.Tensor) -> dict[str, torch.Tensor]:
        seen = super().__call__(robot, counters)
        return {**seen, "depth": -seen["lidar"]}


@pytest.fixture(scope="module")
def teacher(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of the reduced-order model, a few iterations old."""
    spec = NavigationSpec.model_validate_json(SMALL.model_dump_json())
    return train.train(spec, world, FakePerception(), tmp_path_factory.mktemp("teacher"), 7)


SMALL = NavigationSpec.model_validate(
    {
        "env": {"envs": 12, "duration": 4.0, "stay": 1.0},
        "policy": {"attention": 16, "heads": 2, "queries": 2, "recurrent": 16, "hidden": 16, "critic": (16,)},
        "ppo": {"iterations": 4, "steps": 6, "epochs": 2, "minibatches": 3},
    }
)


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return checkpoint.read(folder / "policy.pt")["actor"]


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name, value in a.items():
        assert torch.equal(value, b[name]), name


@settings(max_examples=60, deadline=None)
@given(a=parameters, b=parameters, c=parameters, d=parameters)
def test_divergence_and_gradient_equal_torchs(a: float, b: float, c: float, d: float) -> None:
    p = torch.tensor([[a, c], [b, d]], dtype=torch.float64, requires_grad=True)
    q = torch.tensor([[c, b], [d, a]], dtype=torch.float64, requires_grad=True)
    expected = kl_divergence(Beta(*p.unbind(-2)), Beta(*q.unbind(-2))).sum(-1)
    ours = beta_divergence(p, q)
    torch.testing.assert_close(ours, expected, atol=1e-9, rtol=1e-7)
    pairs = zip(torch.autograd.grad(ours, (p, q)), torch.autograd.grad(expected, (p, q)), strict=True)
    for mine, theirs in pairs:
        torch.testing.assert_close(mine, theirs, atol=1e-9, rtol=1e-6)


def test_single_precision_is_enough_for_a_certain_teacher() -> None:
    p = torch.tensor([[300.0, 2.0, 50.0], [200.0, 90.0, 50.0]])
    q = p + torch.tensor([[1.0, 0.1, 0.0], [0.0, -0.5, 3.0]])
    exact = beta_divergence(p.double(), q.double())
    torch.testing.assert_close(beta_divergence(p, q).double(), exact, atol=1e-3, rtol=0)


@settings(max_examples=40, deadline=None)
@given(a=st.floats(1.01, 300.0), b=st.floats(1.01, 300.0), bound=st.floats(2.5, 50.0))
def test_a_bounded_teacher_keeps_its_mode(a: float, b: float, bound: float) -> None:
    given_, kept = torch.tensor([[a], [b]]), bounded(torch.tensor([[a], [b]]), bound)
    assert kept.sum() <= bound * (1 + 1e-5)
    assert (kept > 1.0).all()
    mode = [(x[0] - 1) / (x.sum() - 2) for x in (given_, kept)]
    torch.testing.assert_close(mode[0], mode[1], atol=1e-3, rtol=1e-3)
    if a + b < bound:
        torch.testing.assert_close(kept, given_)


def test_the_schedule_is_the_papers() -> None:
    shares = [iteration / 2000 for iteration in (0, 100, 600, 1100, 2000)]
    assert [SPEC.weight(share) for share in shares] == pytest.approx([1.0, 1.0, 0.525, 0.05, 0.05])
    assert [Schedule(start=0.0, end=2.0)(share) for share in (0.0, 0.25, 1.0)] == [0.0, 0.5, 2.0]
    with pytest.raises(ValueError, match="rising shares"):
        Schedule(start=1.0, end=0.0, between=(0.6, 0.2))


def rollout(world: World, path: Path, spec: KickstartSpec = SPEC, steps: int = 30) -> tuple[KickstartedPPO, Teacher]:
    """A rollout in which episodes end."""
    torch.manual_seed(0)
    perception = FakePerception()
    env = NavigationEnv(world, ReducedOrderModel(world, 12, 0.2), perception, SMALL.env, 1, "cpu")
    ppo_spec = SMALL.ppo.model_copy(update={"steps": steps})
    obs = env.get_observations()
    ppo = make_ppo(blank_lesson(obs), SMALL.policy, ppo_spec, 12, "cpu", KickstartedPPO)
    own = Teacher(path, perception, spec, SMALL, "cpu")
    ppo.enrol(own, env.places)
    ppo.begin(0.0)
    with torch.inference_mode():
        for _ in range(steps):
            obs, reward, dones, extras = env.step(ppo.act(obs))
            ppo.process_env_step(obs, reward, dones, extras)
        ppo.compute_returns(obs)
    return ppo, own


def test_the_teacher_steps_once_in_a_memory_that_ends_with_the_episode(world: World, teacher: Path) -> None:
    """Its parameters in the rollout are those of one pass over the whole rollout, with episode starts inside."""
    ppo, own = rollout(world, teacher)
    stored = ppo.storage.observations
    starts = torch.zeros(30, 12, dtype=torch.bool)
    starts[1:] = ppo.storage.dones[:-1, :, 0].bool()
    assert starts.any(dim=0).all(), "every episode was to end once"
    memory = torch.zeros(2, 12, 16)
    own.actor(stored, masks=starts, hidden_state=memory, stochastic_output=True)
    expected = torch.stack(own.actor.output_distribution_params, dim=-2)
    assert stored["teacher"].dtype == torch.float32
    torch.testing.assert_close(stored["teacher"], expected, atol=2e-2, rtol=2e-2)
    own.actor(stored, masks=torch.zeros_like(starts), hidden_state=memory, stochastic_output=True)
    never = torch.stack(own.actor.output_distribution_params, dim=-2)
    assert (stored["teacher"] - never).abs().max() > 5 * (stored["teacher"] - expected).abs().max()


@pytest.mark.parametrize("direction", ["teacher-student", "student-teacher"])
def test_distillation_brings_the_student_to_the_teacher(world: World, teacher: Path, direction: str) -> None:
    spec = SPEC.model_copy(update={"direction": direction, "ppo": Schedule(start=0.0, end=1.0, between=(0.5, 1.0))})
    ppo, _ = rollout(world, teacher, spec)
    stored = ppo.storage.observations.clone()
    starts = torch.zeros(30, 12, dtype=torch.bool)
    starts[1:] = ppo.storage.dones[:-1, :, 0].bool()

    def divergence() -> torch.Tensor:
        with torch.no_grad():
            ppo.actor(stored, masks=starts, hidden_state=torch.zeros(2, 12, 16), stochastic_output=True)
            student = torch.stack(ppo.actor.output_distribution_params, dim=-2)
            each = kl_divergence(Beta(*stored["teacher"].unbind(-2)), Beta(*student.unbind(-2))).sum(-1)
        return each.mean()

    before = divergence()
    ppo.num_learning_epochs = 20
    losses = ppo.update()
    assert losses["surrogate"] == 0.0
    assert 0.0 < losses["divergence"] < before * 1.5
    assert divergence() < 0.5 * before
    report = ppo.report()
    assert (report["lambda"], report["ppo_weight"]) == (1.0, 0.0)
    assert report["divergence_same"] > 0.0


def test_without_weight_it_is_ppo(world: World, teacher: Path, spec: NavigationSpec, tmp_path: Path) -> None:
    none = SPEC.model_copy(update={"weight": Schedule(start=0.0, end=0.0)})
    train.train(spec, world, FakePerception(), tmp_path / "plain", 1)
    train.train(spec, world, FakePerception(), tmp_path / "taught", 1, kickstart=(none, teacher))
    assert_same(weights(tmp_path / "plain"), weights(tmp_path / "taught"))


def test_a_student_with_the_teachers_weights_acts_like_it_until_it_has_learned(
    world: World, teacher: Path, spec: NavigationSpec
) -> None:
    perception = WithCamera()
    rest = torch.rand(6, 3), torch.rand(6), torch.rand(6, 3), torch.zeros(6, 2), perception, 30.0
    obs = observe(Feeling(world, 6, 0.2), *rest)
    own = Teacher(teacher, perception, SPEC, spec, "cpu").actor
    student = make_actor(obs, spec.policy)
    assert not torch.allclose(student(obs), own(obs), atol=1e-3)
    inherit(student, own)
    student.reset()
    own.reset()
    for _ in range(3):
        torch.testing.assert_close(student(obs), own(obs), atol=2e-2, rtol=0)
    wider = spec.policy.model_copy(update={"recurrent": 32})
    with pytest.raises(RomnavError, match="give both the same"):
        inherit(make_actor(obs, wider), own)


def test_the_critic_may_learn_first(world: World, teacher: Path, spec: NavigationSpec, tmp_path: Path) -> None:
    kickstart = SPEC.model_copy(update={"critic_first": 0.5, "init": "teacher"})
    keep = spec.model_copy(update={"ppo": spec.ppo.model_copy(update={"keep": 1})})
    train.train(keep, world, FakePerception(), tmp_path, 1, kickstart=(kickstart, teacher))
    kept = [checkpoint.read(tmp_path / "kept" / f"{k:06d}.pt")["actor"] for k in (1, 2, 3)]
    assert_same(kept[0], checkpoint.read(teacher)["actor"])
    assert_same(kept[1], kept[0])
    assert any(not torch.equal(value, kept[1][name]) for name, value in kept[2].items())


def test_a_kickstarted_run_resumes_exactly_and_logs_what_it_weighs(
    world: World, teacher: Path, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)
    body, kickstart = Feeling, (SPEC, teacher)
    run = partial(train.train, spec, world, WithCamera(), seed=1, body=body, kickstart=kickstart)

    class Stop(Exception):
        pass

    def late(done: int, total: int, metric: str) -> None:
        if done == 3 * total // 4:
            raise Stop

    run(out=tmp_path / "whole")
    with pytest.raises(Stop):
        run(out=tmp_path / "half", progress=late)
    assert checkpoint.read(tmp_path / "half" / "checkpoint.pt")["iterations"] == 2
    other = (SPEC.model_copy(update={"direction": "student-teacher"}), teacher)
    with pytest.raises(RomnavError, match="another kickstart"):
        train.train(spec, world, WithCamera(), tmp_path / "half", 1, body=body, kickstart=other)
    run(out=tmp_path / "half")
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "half"))
    rows = list(csv.DictReader((tmp_path / "half" / "curve.csv").open()))
    assert [float(row["lambda"]) for row in rows] == pytest.approx([SPEC.weight(k / 4) for k in range(4)], rel=1e-5)
    assert all(float(row["loss_divergence"]) > 0.0 for row in rows)
    assert {"divergence_same", "divergence_cross", "divergence_stairs", "loss_surrogate"} <= rows[0].keys()
    whole = list(csv.DictReader((tmp_path / "whole" / "curve.csv").open()))
    assert [row["loss_divergence"] for row in rows] == [row["loss_divergence"] for row in whole]


def test_teachers_that_do_not_fit_are_refused(
    world: World, spec: NavigationSpec, teacher: Path, tmp_path: Path
) -> None:
    thawing = spec.model_copy(update={"encoder": EncoderUseSpec(unfreeze_at=0.5)})
    with pytest.raises(RomnavError, match="unfreeze_at"):
        train.train(thawing, world, FakePerception(), tmp_path / "a", 1, kickstart=(SPEC, teacher))
    own = train.train(thawing, world, FakePerception(), tmp_path / "own", 1)
    with pytest.raises(RomnavError, match="frozen encoder"):
        train.train(spec, world, FakePerception(), tmp_path / "b", 1, kickstart=(SPEC, own))
    with pytest.raises(RomnavError, match="no such policy"):
        train.train(spec, world, FakePerception(), tmp_path / "c", 1, kickstart=(SPEC, tmp_path / "none.pt"))
    wider = spec.model_copy(update={"policy": spec.policy.model_copy(update={"support": 1.2})})
    with pytest.raises(RomnavError, match=r"policy\.support = 1, and its student has 1\.2"):
        train.train(wider, world, FakePerception(), tmp_path / "d", 1, kickstart=(SPEC, teacher))


@pytest.mark.parametrize(
    ("key", "own", "difference"),
    [
        ("command", {"forward": 0.3}, r"command\.forward = 1, and its student has 0\.3"),
        ("command", {"reverse": 0.3}, r"command\.reverse = 0\.5, and its student has 0\.3"),
        ("command", {"lateral": 0.3}, r"command\.lateral = 0\.25, and its student has 0\.3"),
        ("command", {"turn": 0.3}, r"command\.turn = 1, and its student has 0\.3"),
        ("max_goal_distance", 20.0, r"max_goal_distance = 30, and its student has 20"),
        ("period", 0.1, r"period = 0\.2, and its student has 0\.1"),
    ],
)
def test_a_teacher_of_another_task_is_refused(
    world: World, spec: NavigationSpec, teacher: Path, tmp_path: Path, key: str, own: object, difference: str
) -> None:
    """The divergence would take the same numbers for the same velocities."""
    other = NavigationSpec.model_validate({**spec.model_dump(), "env": {**spec.env.model_dump(), key: own}})
    with pytest.raises(RomnavError, match=rf"{teacher}: a teacher with navigation\.env\.{difference}; give both"):
        train.train(other, world, FakePerception(), tmp_path, 1, kickstart=(SPEC, teacher))


def test_places_of_the_robots(world: World, spec: NavigationSpec) -> None:
    env = NavigationEnv(world, ReducedOrderModel(world, 12, 0.2), FakePerception(), spec.env, 1, "cpu")
    cross, stairs = env.places().T
    climb = env._goal_position[:, 2] - env.dynamics.position[:, 2]  # nobody has moved yet
    assert torch.equal(cross, climb.abs() > LEVEL_GAP)
    assert 0 < cross.sum() < 12
    for k in range(12):
        grid = world.grids[int(env.dynamics.tile[k])]
        near = (grid.position[:, :2] - env.dynamics.position[k, :2].numpy()).__abs__().max(axis=1) < 0.1
        layered = near & (abs(grid.position[:, 2] - float(env.dynamics.position[k, 2])) < 0.3)
        assert bool(stairs[k]) == bool(grid.connector[layered].any())


def test_tokens_shape_of_the_stand_in() -> None:
    assert fake_encoder().token_shape == TOKENS
    assert blank_lesson(TensorDict({"state": torch.zeros(3, 9)}, batch_size=[3]))["teacher"].shape == (3, 2, 3)
