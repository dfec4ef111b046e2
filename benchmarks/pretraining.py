"""Where the time of pretraining goes: is making the images the bottleneck, or learning from them?

CPU time of one thread. Images come from random poses over tiles of all classes, with labels, and are corrupted as in
training; learning is one gradient step on a batch of them.
"""

from __future__ import annotations

import json
import statistics
import time

import torch
from _common import arguments, markdown, take_turns

from romnav import files
from romnav.experiment.graph import records
from romnav.sensing.corruption import Corruption
from romnav.sensing.depth import DepthCamera
from romnav.sensing.encoder import untrained
from romnav.sensing.lidar import Lidar
from romnav.sensing.pretrain import Poses, Sensor, loss_terms
from romnav.sensing.spec import DepthPretrainSpec, DepthSpec, EncoderSpec, LidarSpec, PretrainSpec
from romnav.threads import torch_threads
from romnav.world.spec import WorldSpec
from romnav.world.tiles import generate

PAPER = EncoderSpec(widths=(32, 64, 64, 64), strides=((2, 2), (2, 2), (3, 3), (1, 2)), latent=64)
SENSORS: dict[str, tuple[type, LidarSpec | DepthSpec, PretrainSpec]] = {
    "LiDAR, 15 x 55": (Lidar, LidarSpec(rows=15, columns=55), PretrainSpec()),
    "LiDAR, 59 x 220": (Lidar, LidarSpec(), PretrainSpec(encoder=PAPER)),
    "depth, 26 x 30": (DepthCamera, DepthSpec(), DepthPretrainSpec()),
}


def measure(sensor: Sensor, poses: Poses, spec: PretrainSpec, repeats: int) -> dict[str, list[float]]:
    """CPU seconds of each part for one batch."""
    index = torch.arange(spec.batch)
    pose = poses(index)
    corrupt = Corruption(spec.corruption, spec.seed)
    clean, labels = sensor.scan(*pose, labels=True)
    seen = corrupt(clean, index, index)
    model = untrained(spec.encoder, sensor.directions, spec.seed)
    optimizer = torch.optim.AdamW(model.parameters(), spec.learning_rate, foreach=True)
    generator = torch.Generator().manual_seed(0)

    def learn() -> None:
        optimizer.zero_grad()
        sum(loss_terms(model, spec, seen, clean, labels, generator).values()).backward()
        optimizer.step()

    works = {
        "poses": lambda: poses(index),
        "images and labels": lambda: pose.scan(sensor, labels=True),
        "corruption": lambda: corrupt(clean, index, index),
        "learning": learn,
    }
    return take_turns(works, repeats, time.process_time, warm_up=3)


def main() -> None:
    """Measure, print and write ``results/bench/pretraining.json``."""
    options = arguments(__doc__, repeats=30, tiles=12)
    world = [generate(WorldSpec(), index) for index in range(options.tiles)]
    record, rows = {}, []
    with torch_threads(1):
        for name, (kind, sensor_spec, spec) in SENSORS.items():
            sensor = kind([tile.solids for tile, _ in world], sensor_spec)
            poses = Poses([grids for _, grids in world], sensor_spec.height, 0, sway=spec.sway)
            parts = {k: statistics.median(v) for k, v in measure(sensor, poses, spec, options.repeats).items()}
            making = sum(parts.values()) - parts["learning"]
            record[name] = {
                "images_per_cpu_second": round(spec.batch / making),
                "learned_per_cpu_second": round(spec.batch / sum(parts.values())),
                "ms_per_batch": {k: round(1000 * v, 3) for k, v in parts.items()},
                "share_of_making_images": round(making / sum(parts.values()), 3),
            }
            rate, learned, share = (record[name][k] for k in list(record[name]) if k != "ms_per_batch")
            rows.append([name, f"{rate:,}", f"{learned:,}", f"{share:.0%}"])
    source = records.provenance()
    text = f"Pretraining, one thread, CPU time, batches of {PretrainSpec().batch}. {source['machine']}.\n\n"
    text += markdown(["", "images made per s", "images learned from per s", "share of making them"], rows)
    print(text, flush=True)
    record |= {"machine": source["machine"], "commit": source["commit"]}
    files.write(options.out / "pretraining.json", json.dumps(record, indent=2) + "\n")
    files.write(options.out / "pretraining.md", text)


if __name__ == "__main__":
    main()
