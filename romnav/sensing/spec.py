"""Configuration of the sensors."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from romnav.config import Config, Count, NonNegative, Pixels, Positive, Range, Rate, Seed, Share, Width

Elevation = Annotated[float, Field(ge=-90.0, le=90.0)]
"""Angle above the horizon, degrees."""
Pitch = Annotated[float, Field(ge=-math.pi / 2, le=math.pi / 2)]
"""Angle about the axis to the left, rad."""
Opening = Annotated[float, Field(gt=0.0, lt=180.0)]
"""Of a camera, degrees."""
Stride = Annotated[int, Field(ge=1, le=16)]
"""Pixels merged into one."""


class LidarSpec(Config):
    """Range image of a Livox Mid-360 in the head of a G1, binned after levelling (paper, Sec. III-B)."""

    rows: Pixels = 59
    """Pixels in elevation; 59 are 1 degree each (P: the degree; A: the number, from ``elevation``)."""
    columns: int = Field(default=220, ge=16, le=4096)
    """Pixels in azimuth; 220 are 1 degree each (P). At least the width of a vector."""
    azimuth: float = Field(default=220.0, gt=0.0, le=360.0)
    """Horizontal field, centred on the forward direction, degrees (P)."""
    elevation: Range[Elevation] = (-55.0, 4.0)
    """Lower and upper edge of the image above the horizon, degrees (A: the mounted sensor's field ahead)."""
    height: Positive = 1.265
    """Sensor above the terrain under a standing robot, m (A: G1 URDF, torso to mid360_link)."""
    mount_pitch: Pitch = 0.0511
    """Pitch of the sensor, which is mounted upside down, in the torso, rad (A: G1 URDF)."""
    field: Range[Elevation] = (-7.0, 52.0)
    """Vertical field in the sensor's own frame, degrees (A: Mid-360 data sheet)."""
    min_range: float = Field(default=0.1, ge=0.001, le=1e6)
    """Nearest return, m (A: Mid-360 data sheet). Above rounding, so that a ray that starts in a solid has none."""
    max_range: Positive = 30.0
    """Farthest return, m (A: as far as goals of training lie; a Mid-360 sees surfaces of 10 % albedo at 40 m)."""
    backend: Literal["columns", "mesh"] = "columns"
    """"columns" intersects the solids in closed form; "mesh" casts rays at their triangles, as an oracle."""

    @model_validator(mode="after")
    def _sees_something(self) -> Self:
        for name in ("elevation", "field"):
            low, high = getattr(self, name)
            if low == high:
                raise ValueError(f"{name}: from {low} to {high} degrees there is nothing to see; widen it")
        _check_ranges(self)
        return self


class DepthSpec(Config):
    """Depth image of a ZED Mini in the head of a G1, looking down (paper, Sec. III-B)."""

    rows: Pixels = 26
    """Pixels downwards (P)."""
    columns: Pixels = 30
    """Pixels across (P)."""
    field: tuple[Opening, Opening] = (85.0, 54.0)
    """Horizontal and vertical field of view, degrees (A: ZED Mini data sheet at 720p)."""
    pitch: Elevation = 60.0
    """Optical axis below the horizon, degrees (A: from the feet to 2 m ahead)."""
    height: Positive = 1.265
    """Camera above the terrain under a standing robot, m (A: beside the LiDAR)."""
    min_range: NonNegative = 0.1
    """Least depth along the optical axis, m (A: ZED Mini data sheet)."""
    max_range: Positive = 6.0
    """Largest depth along the optical axis, m (A: stereo error reaches decimetres there)."""

    @model_validator(mode="after")
    def _sees_something(self) -> Self:
        _check_ranges(self)
        return self


def _check_ranges(spec: LidarSpec | DepthSpec) -> None:
    if spec.min_range >= spec.max_range:
        raise ValueError(f"min_range: {spec.min_range} m, not below max_range, {spec.max_range} m; lower it")


class CorruptionSpec(Config):
    """What is done to clean range images (paper, "Pretraining Vision Encoders")."""

    noise: tuple[NonNegative, NonNegative, NonNegative] = (0.02, 0.001, 0.0)
    """Standard deviation of a range r, ``n0 + n1 r + n2 r^2``, m (A: 3 cm at 10 m, half as much again as
    the Mid-360's data sheet has, and growing as its beam widens)."""
    dropout: Range[Share] = (0.0, 0.8)
    """Least and largest share of lost pixels (P; A: each image draws its own)."""
    occlusion: tuple[tuple[Share, Share, Share, Share], ...] = (
        (0.0, 0.1, 0.75, 1.0),
        (0.9, 1.0, 0.75, 1.0),
        (0.05, 0.08, 0.0, 1.0),
        (0.92, 0.95, 0.0, 1.0),
    )
    """Boxes (left, right, top, bottom) behind the robot, shares of the image (A: shoulders and posts)."""
    occlusion_jitter: Share = 0.02
    """Largest shift of every edge of those boxes between robots, share of the image (A)."""

    @field_validator("occlusion")
    @classmethod
    def _boxes(cls, boxes: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        for left, right, top, bottom in boxes:
            if left > right or top > bottom:
                raise ValueError(f"{[left, right, top, bottom]}; order each box as left, right, top, bottom")
        return boxes


class EncoderSpec(Config):
    """Variational autoencoder of one range sensor."""

    cartesian: bool = True
    """Whether x, y, z are channels and a head beside the range: LiDAR yes (P), depth camera no (A: a pixel's place in
    the image tells them)."""
    scale: Positive = 5.0
    """Length that becomes 1 in the channels and heads, m (A)."""
    widths: tuple[Width, ...] = Field(default=(16, 32, 64, 64), min_length=1)
    """Channels after each stage of convolutions (A)."""
    strides: tuple[tuple[Stride, Stride], ...] = ((2, 2), (2, 2), (2, 2), (1, 2))
    """Rows and columns merged by each stage; 15 x 55 pixels become 2 x 4 tokens (A: few are cheap)."""
    latent: Width = 32
    """Channels of a token (A)."""
    bfloat16: bool = True
    """Compute tokens in bfloat16 where the processor can (A: twice as fast, its error far below the latent's noise)."""

    @model_validator(mode="after")
    def _has_stages(self) -> Self:
        if len(self.widths) != len(self.strides):
            raise ValueError(f"strides: {len(self.strides)} for {len(self.widths)} widths; give one for each stage")
        return self


class SwaySpec(Config):
    """How the head of a walking robot is held, against one that stands upright; uniform within the ranges."""

    roll: Range[Pitch] = (0.0, 0.0)
    """Of the torso, rad."""
    pitch: Range[Pitch] = (0.0, 0.0)
    """Of the torso, rad, positive forwards."""
    sink: Range[NonNegative] = (0.0, 0.0)
    """Sensor below its height on a standing robot, m."""


UPRIGHT = SwaySpec()
WALKING = SwaySpec(roll=(-0.2, 0.2), pitch=(-0.25, 0.25), sink=(0.05, 0.2))
"""As measured while the `cpu` scale's `rom` drove 96 humanoids for 1,280 steps, 1st to 99th percentile."""


class PretrainSpec(Config):
    """Training of one encoder (paper, "Pretraining Vision Encoders")."""

    encoder: EncoderSpec = EncoderSpec()
    """Network."""
    corruption: CorruptionSpec = CorruptionSpec()
    """What is done to the inputs; targets stay clean."""
    sway: SwaySpec = Field(default=UPRIGHT, exclude_if=lambda sway: sway == UPRIGHT)
    """Poses of the head (A: the range image is levelled, so that a tilt moves the edge of what is filled only)."""
    images: Count = 2_000_000
    """Images, half from uniform poses and half on or near stairs and ramps (P)."""
    epochs: Count = 10
    """Passes over the images (P; A: each with new corruption)."""
    batch: int = Field(default=32, ge=1, le=2**16)
    """Images per gradient step (A: steps, not images, limit short runs)."""
    learning_rate: Rate = 4e-3
    """AdamW's learning rate, falling to zero over the last quarter (A: twice is a little faster, and diverges in longer
    runs)."""
    max_grad_norm: Positive = 3000.0
    """Gradient clip, nat (A: about the median norm, so that a rare image cannot throw the weights far)."""
    weight_decay: NonNegative = 1e-4
    """Of AdamW (A)."""
    sigma: Positive = 1.0
    """Deviation of the likelihood behind the squared errors, m (A: weighs geometry against classes)."""
    class_weights: tuple[NonNegative, NonNegative, NonNegative, NonNegative] = (1.0, 1.0, 2.0, 2.0)
    """Weight of a pixel in the segmentation loss by its true class, ground, obstacle, stair, ramp (A: 3 % of the pixels
    are stairs and 6 % ramps, and they decide where a robot can go up)."""
    kl_weight: NonNegative = 0.1
    """Weight of the Kullback-Leibler term (A: at 1, the evidence lower bound itself, stairs are learned far later)."""
    free_bits: NonNegative = 0.5
    """Divergence that each latent dimension has for free, nat (A)."""
    seed: Seed = 0
    """Seed of weights, poses and corruption."""

    @model_validator(mode="after")
    def _fills_a_batch(self) -> Self:
        if self.batch > self.images:
            raise ValueError(f"batch: {self.batch} of {self.images} images (images); lower it")
        return self


class DepthCorruptionSpec(CorruptionSpec):
    """What is done to clean depth images."""

    noise: tuple[NonNegative, NonNegative, NonNegative] = (0.002, 0.0, 0.004)
    """Standard deviation of a depth z, ``n0 + n1 z + n2 z^2``, m (A: 0.2 pixels of disparity at 63 mm baseline and
    700 pixels focal length)."""
    occlusion: tuple[tuple[Share, Share, Share, Share], ...] = ((0.15, 0.85, 0.88, 1.0),)
    """Boxes (left, right, top, bottom), shares of the image (A: the chest hides its lower edge)."""


class DepthEncoderSpec(EncoderSpec):
    """Variational autoencoder of the depth camera."""

    cartesian: bool = False
    """Depth and validity alone (A: the paper names the channels of the range image only)."""
    scale: Positive = 2.0
    """Length that becomes 1 in the channel and head, m (A)."""
    strides: tuple[tuple[Stride, Stride], ...] = ((2, 2), (2, 2), (2, 2), (2, 2))
    """Rows and columns merged by each stage; 26 x 30 pixels become 2 x 2 tokens (A)."""


class DepthPretrainSpec(PretrainSpec):
    """Training of the depth camera's encoder."""

    encoder: DepthEncoderSpec = DepthEncoderSpec()
    """Network."""
    corruption: DepthCorruptionSpec = DepthCorruptionSpec()
    """What is done to the inputs; targets stay clean."""
    sway: SwaySpec = Field(default=WALKING, exclude_if=lambda sway: sway == UPRIGHT)
    """Poses of the head (A: the camera turns with the torso)."""
    sigma: Positive = 0.2
    """Deviation of the likelihood behind the squared errors, m (A: the ground is near)."""


class QualitySpec(Config):
    """Judging an encoder on tiles that it was not trained on."""

    images: int = Field(default=4096, ge=2, le=2**31)
    """Images, posed as in training (A: a per-mille of a class moves its IoU by less than the seed does)."""
    tiles: int = Field(default=64, ge=1, le=2**16)
    """Tiles (A)."""
    seed: Seed = 1000
    """Seed of the tiles; training uses another (A: as the paper does for policies)."""
