"""What a real sensor does to a range image: noise, lost pixels and the robot's own head in view."""

from __future__ import annotations

import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.sensing.spec import CorruptionSpec

wp.set_module_options({"enable_backward": False, "optimization_level": 3, "cpu_compiler_flags": "-march=native -w"})

_GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
_STRIDE = wp.constant(wp.uint32(0x9E3779B1))
_MIX_1 = wp.constant(wp.uint32(0x7FEB352D))
_MIX_2 = wp.constant(wp.uint32(0x846CA68B))
_PAIRS = wp.constant(wp.uint32(0b11111_00000_11111))
_LOW = wp.constant(wp.uint32(0b11111_11111))
_IRWIN_HALL_SD = (4 * (32**2 - 1) / 12) ** 0.5
"""Standard deviation of the sum of four uniform integers below 32."""


@wp.func
def _mix(x: wp.uint32):
    x = x ^ (x >> wp.uint32(16))
    x = x * _MIX_1
    x = x ^ (x >> wp.uint32(15))
    x = x * _MIX_2
    return x ^ (x >> wp.uint32(16))


@wp.func
def _absorb(h: wp.uint32, counter: wp.uint32, k: wp.uint32):
    """One more counter of `romnav.random.bits`."""
    return _mix(h + counter * _STRIDE + k)


@wp.func
def _unit(h: wp.uint32):
    return float(h >> wp.uint32(8)) * (1.0 / 16777216.0)


@wp.func
def _edge(share: float, count: int):
    return int(wp.clamp(share, 0.0, 1.0) * float(count) + 0.5)


@wp.kernel
def _corrupt(
    clean: wp.array2d(dtype=wp.float32),
    env: wp.array(dtype=wp.int32),
    step: wp.array(dtype=wp.int32),
    seed: wp.uint32,
    rows: int,
    columns: int,
    noise: wp.vec3,
    dropout: wp.vec2,
    occlusion: wp.array(dtype=wp.vec4),
    jitter: float,
    out: wp.array2d(dtype=wp.float32),
):
    e = wp.tid()
    of_env = _absorb(_mix(seed ^ _GOLDEN), wp.uint32(env[e]), wp.uint32(1))
    of_step = _absorb(of_env, wp.uint32(step[e]), wp.uint32(2))
    share = dropout[0] + (dropout[1] - dropout[0]) * _unit(_absorb(of_step, wp.uint32(0), wp.uint32(3)))
    lost = wp.uint32(share * 4096.0 + 0.5)
    for p in range(rows * columns):
        # One hash serves both draws: 12 bits choose the lost pixels, four groups of five sum to a bell.
        h = _absorb(of_step, wp.uint32(p + 1), wp.uint32(3))
        pairs = (h & _PAIRS) + ((h >> wp.uint32(5)) & _PAIRS)
        bell = (pairs & _LOW) + (pairs >> wp.uint32(10))
        r = clean[e, p]
        sd = noise[0] + r * (noise[1] + r * noise[2])
        noisy = wp.max(r + sd * (float(bell) - 62.0), 1.0e-3)
        out[e, p] = wp.where((h >> wp.uint32(20)) < lost or r <= 0.0, 0.0, noisy)
    # The head belongs to the robot, not to the moment: its variation depends on the environment alone.
    for k in range(occlusion.shape[0]):
        box = wp.vec4()
        for edge in range(4):
            shift = 2.0 * _unit(_absorb(of_env, wp.uint32(4 * k + edge), wp.uint32(2))) - 1.0
            box[edge] = occlusion[k][edge] + jitter * shift
        left, right = _edge(box[0], columns), _edge(box[1], columns)
        for i in range(_edge(box[2], rows), _edge(box[3], rows)):
            for j in range(left, right):
                out[e, i * columns + j] = 0.0


class Corruption:
    """Corrupts range images by a pure function of (seed, environment, step).

    Noise, pixel dropout and variations of the head's occlusion mask (paper, "Pretraining Vision Encoders").

    Args:
        spec: Strength of each effect.
        seed: Seed of the counter-based random numbers.
        device: Torch device of the images.
    """

    def __init__(self, spec: CorruptionSpec, seed: int, device: str = "cpu") -> None:
        self.spec = spec
        self._seed = seed & 0xFFFFFFFF
        self._device = device
        self._noise = wp.vec3(*(sd / _IRWIN_HALL_SD for sd in spec.noise))
        boxes = torch.tensor(spec.occlusion, dtype=torch.float32, device=device).reshape(-1, 4)
        self._occlusion = wp.from_torch(boxes, dtype=wp.vec4)

    def __call__(self, ranges: Tensor, env: Tensor, step: Tensor) -> Tensor:
        """Corrupted copy of ``ranges`` (E, rows, cols) in metres, 0 where there is no return.

        ``env`` and ``step`` (E,) are integers; the occlusion depends on ``env`` alone.
        """
        out = torch.empty_like(ranges)
        wp.launch(
            _corrupt,
            dim=len(ranges),
            inputs=[
                wp.from_torch(ranges.flatten(1)),
                wp.from_torch(env.to(torch.int32)),
                wp.from_torch(step.to(torch.int32)),
                wp.uint32(self._seed),
                *ranges.shape[1:],
                self._noise,
                wp.vec2(*self.spec.dropout),
                self._occlusion,
                self.spec.occlusion_jitter,
            ],
            outputs=[wp.from_torch(out.flatten(1))],
            device=self._device,
            stream=None if self._device == "cpu" else wp.stream_from_torch(torch.device(self._device)),
        )
        return out
