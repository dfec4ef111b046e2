"""Trainings that are killed at random times and started again: they end in the same bits as one left alone."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from romnav.experiment.graph.stage import digest

ROOT = Path(__file__).parents[1]
PATIENCE = 900.0
"""For a run that is not killed, s."""
TINY = """
[world]
tiles = 2
side = 20.0
classes = ["building", "outdoor"]
goals_per_tile = 8
[lidar]
rows = 8
columns = 16
[depth]
rows = 8
columns = 8
[pretrain]
images = 2048
epochs = 2
[pretrain.encoder]
widths = [8, 8]
strides = [[2, 4], [2, 2]]
latent = 8
[pretrain_depth]
images = 1024
epochs = 1
[pretrain_depth.encoder]
widths = [8, 8]
strides = [[2, 2], [2, 2]]
latent = 8
[quality]
images = 32
tiles = 2
[navigation.env]
envs = 16
duration = 10.0
[navigation.policy]
attention = 8
heads = 2
recurrent = 16
hidden = 16
critic = [16]
[navigation.ppo]
iterations = 40
steps = 8
epochs = 1
minibatches = 2
"""
WALK = """
[locomotion]
iterations = 12
[locomotion.task]
robots = 16
[locomotion.ppo]
steps = 8
"""
EXPERIMENT = """
kind = "ablation"
title = "Two arms side by side"
[tables.pair]
kind = "curves"

[arms.rom]
label = "RoM"
[arms.uniform]
label = "Uniform"
navigation.env.sampler.stair_probability = 0.0
[arms.walker]
label = "On the G1"
navigation.dynamics = "g1"
"""
OFTEN = """
import sys
from romnav.navigation import train as policies
from romnav.robot.locomotion import train as walking
from romnav.sensing import pretrain
policies.SAVE_EVERY, pretrain.CHECKPOINT_INTERVAL = 0.0, 1
walking.train.__kwdefaults__["save_every"] = 0.0
from romnav.cli import main
main()
"""
"""Romnav, but that it saves a checkpoint in every iteration: a kill between two of them is what is tried."""


@dataclass(frozen=True)
class Training:
    """What is run, and the files that it ends in."""

    words: tuple[str, ...]
    ends_in: tuple[str, ...]
    scale: str = TINY
    walks: bool = False
    """Whether it needs a humanoid that walks."""
    makes: str = ""
    """Files of that humanoid that it makes itself, as a pattern."""


TRAININGS = {
    "policy on the reduced-order model": Training(("train", "policy", "rom"), ("rom/seed-0/policy.pt",)),
    "policy on the G1": Training(("train", "policy", "walker"), ("walker/seed-0/policy.pt",), walks=True),
    "encoder": Training(("train", "encoder", "lidar"), ("encoder/lidar/encoder.pt",)),
    "locomotion": Training(("train", "locomotion"), ("locomotion/policy.pt",), scale=WALK),
    "two arms side by side": Training(
        ("run", "ablation", "pair"), ("rom/seed-0/policy.pt", "uniform/seed-0/policy.pt")
    ),
    "gait library": Training(("train", "gaits"), ("locomotion/gaits.pt",), scale="", walks=True, makes="gaits*"),
}


def kill(kind: str, trials: range, folder: Path) -> Counter[str]:
    """Kills a training at a random time in each of numbered ``trials``, resumes it, and compares its weights.

    It is killed alone or with all processes that it has started, as luck has it.
    """
    training = TRAININGS[kind]
    project = _project(training, folder)
    begun = time.monotonic()
    if _run(training, project, "whole"):
        raise SystemExit(f"{kind}: fails without being killed: {_said(project, 'whole')}")
    length = time.monotonic() - begun
    whole = _weights(training, project, "whole")
    count: Counter[str] = Counter()
    for n in trials:
        luck, name = np.random.default_rng([n, *kind.encode()]), f"trial-{n}"
        seconds, alone = float(luck.uniform(0.2, 1.0)) * length, bool(luck.random() < 0.5)
        while not (ended := _run(training, project, name, seconds, alone)):
            shutil.rmtree(project / name)  # it had ended before: nothing was tried
            seconds *= 0.8
        if ended == -signal.SIGKILL:
            ended = _run(training, project, name)
        same = not ended and _weights(training, project, name) == whole
        count["same bits" if same else "lost"] += 1
        if not same:
            print(f"{kind} {n}: {'other weights' if not ended else _said(project, name)}", flush=True)
        shutil.rmtree(project / name, ignore_errors=True)
    return count


def _project(training: Training, folder: Path) -> Path:
    (folder / "experiments" / "scales").mkdir(parents=True)
    walk = (ROOT / "experiments/scales/cpu.toml").read_text().partition("[locomotion]")[2]
    scale = training.scale + (f"[locomotion]{walk}" if training.walks else "")
    (folder / "experiments" / "scales" / "tiny.toml").write_text(scale)
    text = EXPERIMENT if training.walks else EXPERIMENT.partition("[arms.walker]")[0]
    (folder / "experiments" / "pair.toml").write_text(text)
    return folder


def _run(training: Training, project: Path, results: str, kill_after: float = PATIENCE, alone: bool = False) -> int:
    """Runs it to its end, or until it is killed, ``alone`` or with what it has started; the exit status."""
    if training.walks:
        walking, own = project / results / "tiny" / "locomotion", shutil.ignore_patterns(training.makes)
        shutil.copytree(ROOT / "results/cpu/locomotion", walking, dirs_exist_ok=True, ignore=own)
    command = [sys.executable, "-c", OFTEN, *training.words, "--scale", "tiny", "--results", str(project / results)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (project / f"{results}.log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=project, env=environment, stdout=subprocess.DEVNULL, stderr=log, process_group=0
        )
    try:
        return process.wait(kill_after)
    except subprocess.TimeoutExpired:
        (os.kill if alone else os.killpg)(process.pid, signal.SIGKILL)
        return process.wait()
    except KeyboardInterrupt:  # which a group of its own does not hear
        os.killpg(process.pid, signal.SIGKILL)
        raise


def _said(project: Path, results: str) -> str:
    return (project / f"{results}.log").read_text()[-300:]


def _weights(training: Training, project: Path, results: str) -> list[str]:
    """Digests of the weights or gaits; the files also hold how long it took."""
    import torch

    found = []
    for name in training.ends_in:
        content = torch.load(project / results / "tiny" / name, weights_only=True)
        part = project / results / "weights"
        torch.save(_made(content), part)
        found.append(digest(part))
        part.unlink()
    return found


def _made(content: dict[str, Any]) -> Any:
    """What of a file has to be the same."""
    if "gaits" in content:
        return content["gaits"]
    tensors = content.get("actor") or content.get("weights") or content["ppo"]["actor_state_dict"]
    return {key: tensors[key].clone() for key in sorted(tensors)}
