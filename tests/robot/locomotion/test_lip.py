"""The linear inverted pendulum against numerical integration and its own periodicity."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from romnav.robot.g1 import FOOT_LENGTH, build_spec
from romnav.robot.locomotion.legs import Legs
from romnav.robot.locomotion.lip import (
    Walker,
    capture_offset,
    evolve,
    frequency,
    integrate,
    orbit,
    orbit_velocity,
    smoothstep,
    turn_xy,
    wrap,
)
from romnav.robot.spec import GaitSpec, RobotSpec
from romnav.robot.statics import NOTHING

W, T, WIDTH = frequency(0.66), 0.4, 0.2
velocities = st.tuples(st.floats(-0.5, 1.0), st.floats(-0.25, 0.25))
sides = st.sampled_from([1.0, -1.0])


def at(command: tuple[float, float], side: float, time: float) -> tuple[torch.Tensor, torch.Tensor]:
    return orbit(torch.tensor([command]), torch.tensor([side]), torch.tensor([time]), T, WIDTH, W)


@given(velocities, sides, st.floats(0.0, T))
def test_reference_solves_the_pendulum_between_steps(command: tuple[float, float], side: float, time: float) -> None:
    position, velocity = at(command, side, 0.0)
    start = torch.cat([position, velocity], dim=1)[0].double().numpy()
    path = solve_ivp(lambda _, s: [s[2], s[3], W**2 * s[0], W**2 * s[1]], (0.0, T), start, rtol=1e-9, dense_output=True)
    end = torch.cat(at(command, side, time), dim=1)[0].double().numpy()
    assert path.sol(time) == pytest.approx(end, abs=1e-4)
    free = torch.cat(evolve(position, velocity, torch.tensor([[time]]), W), dim=1)[0].numpy()
    assert free == pytest.approx(end, abs=1e-5)


@given(velocities, sides)
def test_reference_is_periodic_and_covers_the_command(command: tuple[float, float], side: float) -> None:
    """The step taken between touch-downs is v T ahead and alternates by the width; velocities join."""
    end, leaving = at(command, side, T)
    begin, entering = at(command, -side, 0.0)
    assert leaving.numpy() == pytest.approx(entering.numpy(), abs=1e-5)
    step = (end - begin)[0].numpy()
    assert step == pytest.approx([command[0] * T, command[1] * T - side * WIDTH], abs=1e-5)


@given(velocities, sides)
def test_capture_offset_is_the_orbit_s_divergent_component_at_touch_down(
    command: tuple[float, float], side: float
) -> None:
    position, velocity = at(command, side, 0.0)
    offset = capture_offset(torch.tensor([command]), torch.tensor([side]), T, WIDTH, W)
    assert offset.numpy() == pytest.approx((position + velocity / W).numpy(), abs=1e-5)


def test_placing_feet_by_the_offset_brings_any_start_onto_the_orbit() -> None:
    """One-step deadbeat in the divergent component; the convergent one decays by exp(-w T) each step."""
    command, side = torch.tensor([[0.6, 0.1]]), torch.tensor([1.0])
    x, v = torch.tensor([[0.1, -0.02]]), torch.tensor([[-0.1, 0.3]])
    for _ in range(6):
        x, v = evolve(x, v, torch.tensor([[T]]), W)
        foot = x + v / W - capture_offset(command, -side, T, WIDTH, W)
        x, side = x - foot, -side
    wanted = torch.cat(at((0.6, 0.1), float(side), 0.0), dim=1)
    assert torch.cat([x, v], dim=1).numpy() == pytest.approx(wanted.numpy(), abs=1e-3)


def mean_velocity(gain: float, loss: float, level: bool = True) -> tuple[float, torch.Tensor]:
    """Of a pendulum under capture-point control that loses a share of its speed at every touch-down."""
    spec = GaitSpec(integral_gain=gain)
    command, side, dt, ticks = torch.tensor([[0.5, 0.0]]), torch.tensor([1.0]), 0.02, 20
    x, v = at((0.5, 0.0), 1.0, 0.0)
    integral, flat, walked = torch.zeros(1, 2), torch.tensor([level]), 0.0
    for step in range(100):
        for _ in range(ticks):
            before = x[0, 0].item()
            integral = integrate(integral, command - v, flat, spec, dt)
            x, v = evolve(x, v, torch.tensor([[dt]]), W)
            walked += x[0, 0].item() - before if step >= 80 else 0.0
        speed = command + integral
        foot = x + v / W - capture_offset(speed, -side, T, WIDTH, W)
        x, v, side = x - foot, v * torch.tensor([1.0 - loss, 1.0]), -side
    return walked / (20 * T), integral


@pytest.mark.parametrize("loss", [0.05, 0.1])
def test_the_integral_takes_away_what_the_pendulum_does_not_know(loss: float) -> None:
    slow, _ = mean_velocity(0.0, loss)
    exact, integral = mean_velocity(1.0, loss)
    assert slow < 0.47
    assert exact == pytest.approx(0.5, abs=2e-3)
    assert 0.02 < integral[0, 0] < 0.3


def test_the_integral_is_bounded_and_forgotten_on_stairs() -> None:
    spec, error = GaitSpec(), torch.tensor([[5.0, -5.0]])
    full = integrate(torch.zeros(1, 2), 100 * error, torch.tensor([True]), spec, 0.02)
    assert full.tolist() == [[pytest.approx(spec.integral_limit), pytest.approx(-spec.integral_limit)]]
    for _ in range(25):
        full = integrate(full, error, torch.tensor([False]), spec, spec.integral_decay / 25)
    assert full[0, 0].item() == pytest.approx(spec.integral_limit * np.exp(-1), rel=0.03)


def test_stairs_are_walked_a_little_faster_than_told_but_only_forwards() -> None:
    command = torch.tensor([[0.5, 0.1], [0.5, 0.1], [0.05, 0.0], [-0.4, 0.0]])
    integral = torch.tensor([[0.02, -0.01]]).expand(4, 2)
    spec = GaitSpec(stair_speed=0.1)
    speed = orbit_velocity(command, integral, torch.tensor([True, False, False, False]), spec)
    expected = torch.tensor([[0.52, 0.09], [0.62, 0.09], [0.07, -0.01], [-0.38, -0.01]])
    torch.testing.assert_close(speed, expected)


@pytest.fixture(scope="module")
def walker() -> Walker:
    model = build_spec(RobotSpec(), NOTHING).compile()
    return Walker(GaitSpec(), Legs(model), 0.02, 1)


def foothold(walker: Walker, ground: Callable[[torch.Tensor], torch.Tensor], x: float, level: float) -> float:
    """Where the walker moves a foothold that it aims at `x`, its stance foot standing at height `level`."""
    point, zero = torch.tensor([[x, 0.0]]), torch.zeros(1)
    moved = walker._clear_of_edges(lambda p, reach: ground(p[..., 0]), point, zero, zero + 9.0, zero + level)
    return moved[0, 0].item()


@given(st.floats(0.0, 0.3), st.sampled_from([0.10, 0.18]), st.floats(0.26, 0.32))
def test_soles_keep_clear_of_risers(walker: Walker, x: float, riser: float, tread: float) -> None:
    """Up and down a flight, the whole sole is on one tread, and as far from the riser as the margin and tread allow."""
    half, margin = FOOT_LENGTH / 2, walker.spec.edge_margin
    for way in (1.0, -1.0):
        place = foothold(walker, lambda p, way=way: way * riser * torch.floor(p / tread), x, 0.0)
        step = np.floor(place / tread)
        before, behind = (step + 1) * tread - (place + half), place - half - step * tread
        assert min(before, behind) > -1e-4
        assert (before if way > 0 else behind) > min(margin, tread - 2 * half - 0.02) - 1e-4


def test_a_drop_beside_the_sole_moves_no_foothold(walker: Walker) -> None:
    edge = 0.3
    place = edge - FOOT_LENGTH / 2 - 0.005
    assert foothold(walker, lambda p: -0.15 * (p > edge), place, 0.0) == pytest.approx(place, abs=1e-6)
    assert foothold(walker, lambda p: 0.15 * (p > edge), place, 0.0) < place - 0.03


def test_small_helpers() -> None:
    t = torch.linspace(-1, 2, 31)
    s = smoothstep(t)
    assert s.min() == 0.0
    assert s.max() == 1.0
    assert (s.diff() >= 0).all()
    assert wrap(torch.tensor(3 * np.pi / 2)).item() == pytest.approx(-np.pi / 2, abs=1e-6)
    assert turn_xy(torch.tensor([1.0, 0.0]), torch.tensor(np.pi / 2)).numpy() == pytest.approx([0, 1], abs=1e-6)
