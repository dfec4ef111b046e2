"""The linear inverted pendulum against numerical integration and its own periodicity."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from romnav.robot.locomotion.lip import capture_offset, evolve, frequency, orbit, smoothstep, turn_xy, wrap

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


def test_small_helpers() -> None:
    t = torch.linspace(-1, 2, 31)
    s = smoothstep(t)
    assert s.min() == 0.0
    assert s.max() == 1.0
    assert (s.diff() >= 0).all()
    assert wrap(torch.tensor(3 * np.pi / 2)).item() == pytest.approx(-np.pi / 2, abs=1e-6)
    assert turn_xy(torch.tensor([1.0, 0.0]), torch.tensor(np.pi / 2)).numpy() == pytest.approx([0, 1], abs=1e-6)
