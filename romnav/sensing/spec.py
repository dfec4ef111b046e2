"""Configuration of the sensors."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from romnav.config import Config


class LidarSpec(Config):
    """Range image of a Livox Mid-360 in the head of a G1, binned after levelling (paper, Sec. III-A)."""

    rows: int = Field(default=59, ge=1)
    """Pixels in elevation; 59 are 1 degree each (P: the degree; A: the number, from ``elevation``)."""
    columns: int = Field(default=220, ge=16)
    """Pixels in azimuth; 220 are 1 degree each (P). At least the width of a vector."""
    azimuth: float = Field(default=220.0, gt=0.0, le=360.0)
    """Horizontal field, centred on the forward direction, degrees (P)."""
    elevation: tuple[float, float] = (-55.0, 4.0)
    """Lower and upper edge of the image above the horizon, degrees (A: the mounted sensor's field ahead)."""
    height: float = 1.265
    """Sensor above the terrain under a standing robot, m (A: G1 URDF, torso to mid360_link)."""
    mount_pitch: float = 0.0511
    """Pitch of the sensor, which is mounted upside down, in the torso, rad (A: G1 URDF)."""
    field: tuple[float, float] = (-7.0, 52.0)
    """Vertical field in the sensor's own frame, degrees (A: Mid-360 data sheet)."""
    min_range: float = Field(default=0.1, ge=0.0)
    """Nearest return, m (A: Mid-360 data sheet)."""
    max_range: float = Field(default=30.0, gt=0.0)
    """Farthest return, m (A: as far as goals of training lie; a Mid-360 sees surfaces of 10 % albedo at 40 m)."""
    backend: Literal["columns", "mesh"] = "columns"
    """"columns" intersects the solids in closed form; "mesh" casts rays at their triangles, as an oracle."""


class DepthSpec(Config):
    """Depth image of a ZED Mini in the head of a G1, looking down (paper, Sec. III-A)."""

    rows: int = Field(default=26, ge=1)
    """Pixels downwards (P)."""
    columns: int = Field(default=30, ge=1)
    """Pixels across (P)."""
    field: tuple[float, float] = (85.0, 54.0)
    """Horizontal and vertical field of view, degrees (A: ZED Mini data sheet at 720p)."""
    pitch: float = 60.0
    """Optical axis below the horizon, degrees (A: from the feet to 2 m ahead)."""
    height: float = 1.265
    """Camera above the terrain under a standing robot, m (A: beside the LiDAR)."""
    min_range: float = Field(default=0.1, ge=0.0)
    """Least depth along the optical axis, m (A: ZED Mini data sheet)."""
    max_range: float = Field(default=6.0, gt=0.0)
    """Largest depth along the optical axis, m (A: stereo error reaches decimetres there)."""


class CorruptionSpec(Config):
    """What is done to clean range images (paper, "Pretraining Vision Encoders")."""

    noise: tuple[float, float, float] = (0.02, 0.001, 0.0)
    """Standard deviation of a range r, ``n0 + n1 r + n2 r^2``, m (A: Mid-360 data sheet, 2 cm at 10 m)."""
    dropout: tuple[float, float] = (0.0, 0.8)
    """Least and largest share of lost pixels (P; A: each image draws its own)."""
    occlusion: tuple[tuple[float, float, float, float], ...] = (
        (0.0, 0.1, 0.75, 1.0),
        (0.9, 1.0, 0.75, 1.0),
        (0.05, 0.08, 0.0, 1.0),
        (0.92, 0.95, 0.0, 1.0),
    )
    """Boxes (left, right, top, bottom) behind the robot, shares of the image (A: shoulders and posts)."""
    occlusion_jitter: float = Field(default=0.02, ge=0.0)
    """Largest shift of every edge of those boxes between robots, share of the image (A)."""


class EncoderSpec(Config):
    """Variational autoencoder of one range sensor."""

    cartesian: bool = True
    """Whether x, y, z are channels and a head beside the range: LiDAR yes (P), depth camera no (A: a pixel's place in
    the image tells them)."""
    scale: float = Field(default=5.0, gt=0.0)
    """Length that becomes 1 in the channels and heads, m (A)."""
    widths: tuple[int, ...] = (16, 32, 64, 64)
    """Channels after each stage of convolutions (A)."""
    strides: tuple[tuple[int, int], ...] = ((2, 2), (2, 2), (2, 2), (1, 2))
    """Rows and columns merged by each stage; 15 x 55 pixels become 2 x 4 tokens (A: few are cheap)."""
    latent: int = 32
    """Channels of a token (A)."""
    bfloat16: bool = True
    """Compute tokens in bfloat16 where the processor can (A: twice as fast, its error far below the latent's noise)."""


class PretrainSpec(Config):
    """Training of one encoder (paper, "Pretraining Vision Encoders")."""

    encoder: EncoderSpec = EncoderSpec()
    """Network."""
    corruption: CorruptionSpec = CorruptionSpec()
    """What is done to the inputs; targets stay clean."""
    images: int = Field(default=2_000_000, ge=1)
    """Images, half from uniform poses and half on or near stairs and ramps (P)."""
    epochs: int = Field(default=10, ge=1)
    """Passes over the images (P; A: each with new corruption)."""
    batch: int = Field(default=32, ge=1)
    """Images per gradient step (A: steps, not images, limit short runs)."""
    learning_rate: float = 4e-3
    """AdamW's learning rate, falling to zero over the last quarter (A: twice is a little faster, and diverges in longer
    runs)."""
    max_grad_norm: float = Field(default=3000.0, gt=0.0)
    """Gradient clip, nat (A: about the median norm, so that a rare image cannot throw the weights far)."""
    weight_decay: float = 1e-4
    """Of AdamW (A)."""
    sigma: float = Field(default=1.0, gt=0.0)
    """Deviation of the likelihood behind the squared errors, m (A: weighs geometry against classes)."""
    class_weights: tuple[float, float, float, float] = (1.0, 1.0, 2.0, 2.0)
    """Weight of a pixel in the segmentation loss by its true class, ground, obstacle, stair, ramp (A: 3 % of the pixels
    are stairs and 6 % ramps, and they decide where a robot can go up)."""
    kl_weight: float = 0.1
    """Weight of the Kullback-Leibler term (A: at 1, the evidence lower bound itself, stairs are learned far later)."""
    free_bits: float = 0.5
    """Divergence that each latent dimension has for free, nat (A)."""
    seed: int = Field(default=0, ge=0)
    """Seed of weights, poses and corruption."""


class DepthCorruptionSpec(CorruptionSpec):
    """What is done to clean depth images."""

    noise: tuple[float, float, float] = (0.002, 0.0, 0.004)
    """Standard deviation of a depth z, ``n0 + n1 z + n2 z^2``, m (A: 0.2 pixels of disparity at 63 mm baseline and
    700 pixels focal length)."""
    occlusion: tuple[tuple[float, float, float, float], ...] = ((0.15, 0.85, 0.88, 1.0),)
    """Boxes (left, right, top, bottom), shares of the image (A: the chest hides its lower edge)."""


class DepthEncoderSpec(EncoderSpec):
    """Variational autoencoder of the depth camera."""

    cartesian: bool = False
    """Depth and validity alone (A: the paper names the channels of the range image only)."""
    scale: float = Field(default=2.0, gt=0.0)
    """Length that becomes 1 in the channel and head, m (A)."""
    strides: tuple[tuple[int, int], ...] = ((2, 2), (2, 2), (2, 2), (2, 2))
    """Rows and columns merged by each stage; 26 x 30 pixels become 2 x 2 tokens (A)."""


class DepthPretrainSpec(PretrainSpec):
    """Training of the depth camera's encoder."""

    encoder: DepthEncoderSpec = DepthEncoderSpec()
    """Network."""
    corruption: DepthCorruptionSpec = DepthCorruptionSpec()
    """What is done to the inputs; targets stay clean."""
    sigma: float = Field(default=0.2, gt=0.0)
    """Deviation of the likelihood behind the squared errors, m (A: the ground is near)."""


class QualitySpec(Config):
    """Judging an encoder on tiles that it was not trained on."""

    images: int = Field(default=4096, ge=1)
    """Images, posed as in training (A: a per-mille of a class moves its IoU by less than the seed does)."""
    tiles: int = Field(default=64, ge=1)
    """Tiles (A)."""
    seed: int = Field(default=1000, ge=0)
    """Seed of the tiles; training uses another (A: as the paper does for policies)."""
