"""The linear inverted pendulum against numerical integration and its own periodicity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from romnav.kernels import wp
from romnav.robot.locomotion.lip import (
    capture_offset,
    gait_of,
    integrate,
    orbit,
    orbit_velocity,
    smoothstep,
    turned,
    wrap,
)
from romnav.robot.spec import GaitSpec

SPEC, DT = GaitSpec(), 0.02
GAIT = gait_of(SPEC, DT)
W, T, WIDTH = np.sqrt(9.81 / 0.66), 0.4, 0.2
velocities = st.tuples(st.floats(-0.5, 1.0), st.floats(-0.25, 0.25))
sides = st.sampled_from([1.0, -1.0])


def at(command: tuple[float, float], side: float, time: float) -> tuple[NDArray, NDArray]:
    position, velocity = orbit(GAIT, wp.vec2(command), side, time)
    return np.array(position), np.array(velocity)


def offset(command: tuple[float, float], side: float) -> NDArray:
    return np.array(capture_offset(GAIT, wp.vec2(command), side))


def evolve(position: NDArray, velocity: NDArray, time: float) -> tuple[NDArray, NDArray]:
    """State of the pendulum after `time`: the exact solution of x'' = w^2 x."""
    c, s = np.cosh(W * time), np.sinh(W * time)
    return c * position + s / W * velocity, W * s * position + c * velocity


@given(velocities, sides, st.floats(0.0, T))
def test_reference_solves_the_pendulum_between_steps(command: tuple[float, float], side: float, time: float) -> None:
    start = np.concatenate(at(command, side, 0.0))
    path = solve_ivp(lambda _, s: [s[2], s[3], W**2 * s[0], W**2 * s[1]], (0.0, T), start, rtol=1e-9, dense_output=True)
    assert path.sol(time) == pytest.approx(np.concatenate(at(command, side, time)), abs=1e-4)


@given(velocities, sides)
def test_reference_is_periodic_and_covers_the_command(command: tuple[float, float], side: float) -> None:
    """The step taken between touch-downs is v T ahead and alternates by the width; velocities join."""
    end, leaving = at(command, side, T)
    begin, entering = at(command, -side, 0.0)
    assert leaving == pytest.approx(entering, abs=1e-5)
    assert end - begin == pytest.approx([command[0] * T, command[1] * T - side * WIDTH], abs=1e-5)


@given(velocities, sides)
def test_capture_offset_is_the_orbit_s_divergent_component_at_touch_down(
    command: tuple[float, float], side: float
) -> None:
    position, velocity = at(command, side, 0.0)
    assert offset(command, side) == pytest.approx(position + velocity / W, abs=1e-5)


def test_placing_feet_by_the_offset_brings_any_start_onto_the_orbit() -> None:
    """One-step deadbeat in the divergent component; the convergent one decays by exp(-w T) each step."""
    side, x, v = 1.0, np.array([0.1, -0.02]), np.array([-0.1, 0.3])
    for _ in range(6):
        x, v = evolve(x, v, T)
        x, side = -(v / W - offset((0.6, 0.1), -side)), -side
    wanted = np.concatenate(at((0.6, 0.1), side, 0.0))
    assert np.concatenate([x, v]) == pytest.approx(wanted, abs=1e-3)


def mean_velocity(gain: float, loss: float) -> tuple[float, float]:
    """Of a pendulum under capture-point control that loses a share of its speed at every touch-down; the integral."""
    gait = gait_of(GaitSpec(integral_gain=gain), DT)
    command, side, ticks = np.array([0.5, 0.0]), 1.0, 20
    x, v = at((0.5, 0.0), 1.0, 0.0)
    integral, walked = wp.vec2(), 0.0
    for step in range(100):
        for _ in range(ticks):
            before = x[0]
            integral = integrate(gait, integral, wp.vec2(command - v), True)
            x, v = evolve(x, v, DT)
            walked += x[0] - before if step >= 80 else 0.0
        x, side = -(v / W - offset(tuple(command + np.array(integral)), -side)), -side
        v = v * np.array([1.0 - loss, 1.0])
    return walked / (20 * T), integral[0]


@pytest.mark.parametrize("loss", [0.05, 0.1])
def test_the_integral_takes_away_what_the_pendulum_does_not_know(loss: float) -> None:
    slow, _ = mean_velocity(0.0, loss)
    exact, integral = mean_velocity(1.0, loss)
    assert slow < 0.47
    assert exact == pytest.approx(0.5, abs=2e-3)
    assert 0.02 < integral < 0.3


def test_the_integral_is_bounded_and_forgotten_on_stairs() -> None:
    full = integrate(GAIT, wp.vec2(), wp.vec2(500.0, -500.0), True)
    assert list(full) == pytest.approx([SPEC.integral_limit, -SPEC.integral_limit])
    for _ in range(25):
        full = integrate(gait_of(SPEC, SPEC.integral_decay / 25), full, wp.vec2(500.0, -500.0), False)
    assert full[0] == pytest.approx(SPEC.integral_limit * np.exp(-1), rel=0.03)


@pytest.mark.parametrize(
    ("command", "level", "expected"),
    [
        ((0.5, 0.1), True, (0.52, 0.09)),
        ((0.5, 0.1), False, (0.62, 0.09)),
        ((0.05, 0.0), False, (0.07, -0.01)),
        ((-0.4, 0.0), False, (-0.38, -0.01)),
    ],
)
def test_stairs_are_walked_a_little_faster_than_told_but_only_forwards(
    command: tuple[float, float], level: bool, expected: tuple[float, float]
) -> None:
    gait = gait_of(GaitSpec(stair_speed=0.1), DT)
    speed = orbit_velocity(gait, wp.vec2(command), wp.vec2(0.02, -0.01), level)
    assert list(speed) == pytest.approx(expected)


def test_small_helpers() -> None:
    s = np.array([smoothstep(t) for t in np.linspace(-1, 2, 31).tolist()])
    assert s.min() == 0.0
    assert s.max() == 1.0
    assert (np.diff(s) >= 0).all()
    assert wrap(3 * np.pi / 2) == pytest.approx(-np.pi / 2, abs=1e-6)
    assert list(turned(wp.vec2(1.0, 0.0), np.pi / 2)) == pytest.approx([0, 1], abs=1e-6)
