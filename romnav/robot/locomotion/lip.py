"""The linear inverted pendulum: closed form, periodic walking, foot placement, and the reference on terrain.

Between steps the centre of mass, relative to the stance foot, obeys x'' = w^2 x with w = sqrt(g / z). Foot
placement brings the divergent component of motion xi = x + x'/w, predicted at touch-down, onto the offset
that the periodic gait of the commanded velocity has there (capture-point control: Pratt et al. 2006,
Englsberger et al. 2015; H-LIP orbits: Xiong and Ames 2022).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from romnav.robot.g1 import FOOT_LENGTH, SOLE, Robots
from romnav.robot.locomotion.legs import Legs, rotation
from romnav.robot.locomotion.terrain import Heights
from romnav.robot.spec import GaitSpec

GRAVITY = 9.81


def frequency(height: float) -> float:
    """Natural frequency of the pendulum, 1/s."""
    return math.sqrt(GRAVITY / height)


def evolve(position: Tensor, velocity: Tensor, time: Tensor, w: float) -> tuple[Tensor, Tensor]:
    """State of the pendulum after `time`, s: the exact solution of x'' = w^2 x."""
    c, s = torch.cosh(w * time), torch.sinh(w * time)
    return c * position + s / w * velocity, w * s * position + c * velocity


def orbit(
    command: Tensor, side: Tensor, time: Tensor, duration: float, width: float, w: float
) -> tuple[Tensor, Tensor]:
    """Periodic gait of a commanded velocity: the centre of mass from the stance foot, and its velocity.

    Args:
        command: (n, 2) forward and lateral velocity, m/s.
        side: (n,) +1 where the left foot stands, -1 where the right.
        time: (n,) since touch-down, s, in [0, duration].
        duration: of one step, s.
        width: between the feet, m.
        w: pendulum frequency, 1/s.

    Returns:
        Position (n, 2), m, and velocity (n, 2), m/s, in the heading frame.
    """
    t = time[:, None] - duration / 2
    amplitude = command * duration / 2 / math.sinh(w * duration / 2)
    position, velocity = amplitude * torch.sinh(w * t), amplitude * w * torch.cosh(w * t)
    sway = -side[:, None] * width / 2 / math.cosh(w * duration / 2)
    lateral = torch.tensor([0.0, 1.0])
    return position + lateral * sway * torch.cosh(w * t), velocity + lateral * sway * w * torch.sinh(w * t)


def capture_offset(command: Tensor, next_side: Tensor, duration: float, width: float, w: float) -> Tensor:
    """Divergent component (n, 2) ahead of the new stance foot at touch-down of the periodic gait, m."""
    offset = command * duration / (math.exp(w * duration) - 1.0)
    lateral = torch.tensor([0.0, 1.0]) * next_side[:, None]
    return offset - lateral * width / (math.exp(w * duration) + 1.0)


def integrate(integral: Tensor, error: Tensor, level: Tensor, spec: GaitSpec, dt: float) -> Tensor:
    """Integral (n, 2) of the velocity error (n, 2) after `dt`, m/s; it decays where the ground is not level (n,)."""
    change = torch.where(level[:, None], spec.integral_gain * error, -integral / spec.integral_decay)
    return (integral + dt * change).clamp(-spec.integral_limit, spec.integral_limit)


def orbit_velocity(command: Tensor, integral: Tensor, level: Tensor, spec: GaitSpec) -> Tensor:
    """Velocity (n, 2) of the orbit for a commanded one (n, 2): corrected, and a little faster up and down stairs."""
    faster = spec.stair_speed * (~level & (command[:, 0] > spec.stair_speed))
    return command + integral + torch.stack([faster, torch.zeros_like(faster)], dim=1)


def smoothstep(t: Tensor) -> Tensor:
    """Minimum-jerk rise from 0 to 1 over t in [0, 1], clamped."""
    t = t.clamp(0.0, 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


def wrap(angle: Tensor) -> Tensor:
    """Angle in (-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


def turn_xy(vector: Tensor, angle: Tensor) -> Tensor:
    """Rotate horizontal vectors (..., 2) by angle (...), rad."""
    c, s = torch.cos(angle), torch.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack([c * x - s * y, s * x + c * y], dim=-1)


@dataclass
class Reference:
    """What the gait asks for now; world frame unless said otherwise, metres, seconds, radians.

    Attributes:
        side: (n,) +1 where the left foot stands.
        phase: (n,) part of the step done.
        joints: (n, 2, 6) leg joint angles from inverse kinematics.
        torque: (n, 2, 6) that carries the weight, N m.
        com, com_velocity: (n, 2) orbit relative to the stance foot, heading frame.
        height: (n,) of the pelvis.
        heading: (n,) reference heading.
        swing: (n, 3) swing sole now.
        foothold: (n, 3) where it is to land.
        sole: (n, 2, 3) both soles as they are.
        ground: (n,) mean ground height under both feet.
    """

    side: Tensor
    phase: Tensor
    joints: Tensor
    torque: Tensor
    com: Tensor
    com_velocity: Tensor
    height: Tensor
    heading: Tensor
    swing: Tensor
    foothold: Tensor
    sole: Tensor
    ground: Tensor


class Walker:
    """Phase clock, footholds and swing of a batch of robots: turns a velocity command into a `Reference`.

    `STATE` names what it remembers of each robot: the clock, where the swing foot left the ground, where it is
    to land, where the stance foot was to land and whether it has, the mean ground height at the start of the
    step, the heading and velocity it follows, the integral of the velocity's error, and the last solution of the
    inverse kinematics.
    """

    STATE = ("clock", "lift", "foothold", "planted", "landed", "base", "heading", "command", "integral", "joints")

    def __init__(self, spec: GaitSpec, legs: Legs, control_dt: float, count: int) -> None:
        self.spec, self.legs = spec, legs
        self.duration = spec.step_ticks * control_dt
        self.dt = control_dt
        self.w = frequency(spec.pendulum)
        self.clock = torch.zeros(count, dtype=torch.long)
        self.lift = torch.zeros(count, 3)
        self.foothold = torch.zeros(count, 3)
        self.planted = torch.zeros(count, 3)
        self.landed = torch.ones(count, dtype=torch.bool)
        self.base = torch.zeros(count)
        self.heading = torch.zeros(count)
        self.command = torch.zeros(count, 3)
        self.integral = torch.zeros(count, 2)
        self.joints = self.stance().expand(count, 2, 6).clone()

    def stance(self) -> Tensor:
        """Leg joints (1, 2, 6) of standing at the nominal height with the feet apart."""
        y = self.spec.width / 2
        ankle = torch.tensor(
            [[[-SOLE[0], y, -self.spec.pelvis - SOLE[2]], [-SOLE[0], -y, -self.spec.pelvis - SOLE[2]]]]
        )
        start = torch.tensor([-0.3, 0.0, 0.0, 0.6, -0.3, 0.0]).expand(1, 2, 6)
        return self.legs.inverse(ankle, torch.eye(3).expand(1, 2, 3, 3), start, iterations=20)

    def reset(self, ids: Tensor, clock: Tensor, heading: Tensor, velocity: Tensor) -> None:
        """Start robots `ids` at `clock` (k,), a multiple of the step's ticks, with their feet side by side and
        `velocity` (k, 2), m/s, in the heading frame."""
        self.command[ids, :2] = velocity
        self.command[ids, 2] = 0.0
        self.integral[ids] = 0.0
        self.clock[ids] = clock
        self.heading[ids] = heading
        self.joints[ids] = self.stance().expand(len(ids), 2, 6)

    def soles(self, robots: Robots) -> Tensor:
        """Centres (n, 2, 3) of the soles, left and right, world."""
        return robots.ankle + robots.ankle_rotation @ torch.tensor(SOLE)

    def _along(self, point: Tensor, heading: Tensor, offsets: Tensor) -> Tensor:
        """Points (n, k, 2) at `offsets` (k,) or (n, k) ahead of `point` (n, 2)."""
        ahead = torch.stack([torch.cos(heading), torch.sin(heading)], dim=-1)
        return point[:, None] + offsets[..., None] * ahead[:, None]

    def _clear_of_edges(self, ground: Heights, point: Tensor, heading: Tensor, reach: Tensor, level: Tensor) -> Tensor:
        """Move footholds (n, 2) along the heading to where the ground under the sole is nearest to a plane and no
        riser is close to it, not more than a riser from the `level` (n,) of the stance foot.

        The shin leans over the toes into the next riser's nose, and on the way down the heel catches on the last
        one's; a drop beside the sole does no harm."""
        tries = torch.linspace(-1.0, 1.0, 15) * self.spec.edge_search
        half, margin = FOOT_LENGTH / 2, self.spec.edge_margin * torch.tensor([0.5, 1.0])
        sole = torch.linspace(-half, half, 7)
        line = torch.cat([sole, half + margin, -half - margin])
        at = self._along(point, heading, (tries[:, None] + line).flatten())
        height = ground(at, reach[:, None]).reshape(len(point), len(tries), len(line))
        heel, toe = height[..., :1], height[..., 6:7]
        over = height - heel - (toe - heel) * (line + half) / (2 * half)
        bump, riser = over[..., :7].abs().amax(-1), over[..., 7:].amax(-1)
        climb = ((height[..., :7].amax(-1) - level[:, None]).abs() - self.spec.climb).clamp(min=0.0)
        cost = 8.0 * (bump - 0.015).clamp(min=0.0) + 4.0 * (riser - 0.015).clamp(min=0.0) + 20.0 * climb
        best = (tries.abs() + cost).argmin(1)
        return self._along(point, heading, tries[best][:, None])[:, 0]

    def update(self, robots: Robots, command: Tensor, ground: Heights, *, first: Tensor | None = None) -> Reference:
        """The reference of this control step.

        Args:
            robots: their states.
            command: (n, 3) forward, lateral, m/s, and yaw rate, rad/s, heading frame.
            ground: walking surfaces.
            first: (n,) robots that were just reset.
        """
        s = self.spec
        rows = torch.arange(len(command))
        tick = self.clock % s.step_ticks
        stance_left = (self.clock // s.step_ticks) % 2 == 0
        side = torch.where(stance_left, 1.0, -1.0)
        stance, swing = (~stance_left).long(), stance_left.long()
        phase = tick / s.step_ticks
        fresh = torch.zeros_like(tick, dtype=torch.bool) if first is None else first
        start = (tick == 0) | fresh

        sole = self.soles(robots)
        # A foot that is late keeps aiming at its foothold until it touches the ground.
        self.planted = torch.where(
            start[:, None], torch.where(fresh[:, None], sole[rows, stance], self.foothold), self.planted
        )
        landed = robots.touch[:, robots.feet][rows, stance] | fresh
        self.landed = torch.where(start, landed, self.landed | landed)
        p = torch.where(self.landed[:, None], sole[rows, stance], self.planted)
        swinging = sole[rows, swing]
        reach = p[:, 2] + 0.5
        under = ground(sole[..., :2], reach[:, None])
        mean = under.mean(1)
        self.base = torch.where(start, mean, self.base)
        self.lift = torch.where(start[:, None], swinging, self.lift)

        yaw = torch.atan2(robots.orientation[:, 1, 0], robots.orientation[:, 0, 0])
        velocity = turn_xy(robots.com_velocity[:, :2], -yaw)
        apart = torch.maximum((self.foothold[:, 2] - self.base).abs(), (under[:, 0] - under[:, 1]).abs())
        level = (apart < s.level) | fresh
        # Who is held by a wall would lean into it ever more.
        fastest = torch.where(level, velocity[:, 0].clamp(min=0.0) + s.ahead, torch.inf)
        held = command[:, 0] > fastest
        wanted = torch.cat([torch.minimum(command[:, 0], fastest)[:, None], command[:, 1:]], dim=1)
        slew = torch.tensor(s.acceleration) * self.dt
        self.command = self.command + torch.maximum(torch.minimum(wanted - self.command, slew), -slew)
        turn = self.command[:, 2]
        lead = wrap(self.heading + turn * self.dt - yaw).clamp(-0.35, 0.35)
        self.heading = wrap(yaw + lead)

        # The pendulum knows neither the body's lag nor turning frames: their constant errors are integrated away,
        # but not where the integral would wind up: held by a wall, and on stairs, where treads bound the steps. There,
        # who loses its speed steps back down to regain it, and falls: it aims at a little more.
        error = self.command[:, :2] - velocity
        self.integral = integrate(self.integral, error, level & ~held, s, self.dt)
        speed = orbit_velocity(self.command[:, :2], self.integral, level, s)

        # Foothold: the divergent component at touch-down, less the periodic gait's offset, within reach.
        left = (1.0 - phase) * self.duration - s.early
        x = robots.com[:, :2] - p[:, :2]
        xi = (x + robots.com_velocity[:, :2] / self.w) * torch.exp(self.w * left)[:, None]
        landing = self.heading + turn * left
        step = turn_xy(xi, -landing) - capture_offset(speed, -side, self.duration, s.width, self.w)
        ahead = step[:, 0].clamp(*s.reach_forward)
        beside = (-side * step[:, 1]).clamp(*s.reach_side)
        aim = p[:, :2] + turn_xy(torch.stack([ahead, -side * beside], dim=-1), landing)
        aim = self._clear_of_edges(ground, aim, landing, reach, under[rows, stance])
        # Late corrections would drag the foot over an edge, early ones are noise amplified by exp(w t).
        blend = torch.where(start, 1.0, 0.4)[:, None]
        horizontal = self.foothold[:, :2] + blend * (aim - self.foothold[:, :2])
        self.foothold = torch.cat([horizontal, ground(horizontal, reach)[:, None]], dim=1)

        # Swing: up over the highest ground on the way, then across, then down.
        t = phase / s.swing_end
        way = self.lift[:, None, :2] + torch.linspace(-0.1, 1.3, 9)[:, None] * (self.foothold - self.lift)[:, None, :2]
        apex = torch.maximum(ground(way, reach[:, None]).amax(1), self.lift[:, 2]) + s.clearance
        rise = self.lift[:, 2] + (apex - self.lift[:, 2]) * smoothstep(t / 0.45)
        fall = apex + (self.foothold[:, 2] - apex) * smoothstep((t - 0.55) / 0.45)
        across = (
            self.lift[:, :2]
            + (self.foothold - self.lift)[:, :2] * smoothstep((t - 0.1) / (s.swing_across - 0.1))[:, None]
        )
        foot = torch.cat([across, torch.where(t < 0.5, rise, fall)[:, None]], dim=1)

        # Pelvis: from the mean height of the feet at the start of the step to that at its end.
        after = (under[rows, stance] + self.foothold[:, 2]) / 2
        between = (under[rows, stance] - self.foothold[:, 2]).abs()
        height = s.pelvis + self.base + (after - self.base) * smoothstep(phase) - s.sink * between

        com, com_velocity = orbit(speed, side, phase * self.duration, self.duration, s.width, self.w)
        pull = turn_xy(com + com_velocity / self.w, self.heading) - x - robots.com_velocity[:, :2] / self.w
        pull = s.pull * pull.clamp(-0.1, 0.1)
        joints = self._inverse(robots, rows, stance, swing, sole, p, foot, height, pull, landing, ground, reach)
        self.clock = (self.clock + 1) % (2 * s.step_ticks)
        return Reference(
            side, phase, joints, self._weight(robots, rows, stance, swing, sole, phase), com, com_velocity, height,
            self.heading, foot, self.foothold, sole, mean,
        )  # fmt: skip

    def _inverse(
        self, robots: Robots, rows: Tensor, stance: Tensor, swing: Tensor, sole: Tensor, planted: Tensor,
        foot: Tensor, height: Tensor, pull: Tensor, landing: Tensor, ground: Heights, reach: Tensor,
    ) -> Tensor:  # fmt: skip
        """Leg joints: the swing foot placed from the pelvis as it is, the stance leg under the pelvis as wanted."""
        n = len(rows)
        half = FOOT_LENGTH / 2
        feet = sole.clone()
        feet[rows, stance], feet[rows, swing] = planted, foot
        foot_yaw = torch.atan2(robots.ankle_rotation[..., 1, 0], robots.ankle_rotation[..., 0, 0])
        foot_yaw[rows, swing] = landing
        centre = feet.clone()
        centre[rows, swing, :2] = self.foothold[:, :2]
        ahead = torch.stack([torch.cos(foot_yaw), torch.sin(foot_yaw)], dim=-1) * half
        along = centre[:, None, :, :2] + torch.tensor([1.0, 0.0, -1.0])[:, None, None] * ahead[:, None]
        toe, middle, heel = ground(along, reach[:, None, None]).unbind(1)
        # The sole lies along the ground where that is a plane, level where it is an edge.
        plane = ((toe + heel) / 2 - middle).abs() < 0.012
        pitch = torch.where(plane & ((toe - heel).abs() < 0.13), -torch.atan2(toe - heel, torch.tensor(2 * half)), 0.0)
        feet_turn = rotation(2, foot_yaw) @ rotation(1, pitch)

        body = robots.orientation
        down = body[:, 2]
        tilt = torch.stack([down[:, 1], -down[:, 0]], dim=-1) * self.spec.upright_gain
        wanted = rotation(2, self.heading) @ rotation(1, -tilt[:, 1]) @ rotation(0, -tilt[:, 0])
        turn = torch.empty(n, 2, 3, 3)
        turn[rows, stance], turn[rows, swing] = wanted, body
        forward = robots.velocity[:, :2] * self.dt
        pelvis = torch.cat([robots.pelvis[:, :2] + forward, robots.pelvis[:, 2:]], dim=1)[:, None].repeat(1, 2, 1)
        pelvis[rows, stance, 2] = height
        pelvis[rows, stance, :2] += pull
        ankle = feet - feet_turn @ torch.tensor(SOLE)
        inverse = turn.transpose(-1, -2)
        self.joints = self.legs.inverse(
            (inverse @ (ankle - pelvis)[..., None])[..., 0], inverse @ feet_turn, self.joints
        )
        return self.joints

    def _weight(
        self, robots: Robots, rows: Tensor, stance: Tensor, swing: Tensor, sole: Tensor, phase: Tensor
    ) -> Tensor:
        """Joint torques (n, 2, 6) that hold the ground force of the pendulum on each foot, N m."""
        share = torch.empty(len(rows), 2)
        share[rows, stance] = (0.5 + 2.5 * phase).clamp(max=1.0)
        share[rows, swing] = 1.0 - share[rows, stance]
        lean = (robots.com[:, None, :2] - sole[..., :2]).clamp(-0.3, 0.3) / self.spec.pendulum
        force = torch.cat([lean, torch.ones_like(lean[..., :1])], dim=-1) * (robots.mass * GRAVITY) * share[..., None]
        anchor, axis = robots.anchor[:, :12].reshape(-1, 2, 6, 3), robots.axis[:, :12].reshape(-1, 2, 6, 3)
        moment = torch.linalg.cross(sole[:, :, None] - anchor, force[:, :, None].expand(-1, -1, 6, -1))
        return -(axis * moment).sum(-1)
