"""What episodes and trials share: an arm, trained or scripted, that drives robots and leaves rows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from romnav import __version__
from romnav.evaluation.spec import EvaluationSpec, TrialSpec
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Stage
from romnav.experiment.kinds.locomotion import body, cpu_only, walking
from romnav.experiment.kinds.policy import perception, policy
from romnav.experiment.scales import Scale
from romnav.experiment.spec import DRIVERS, SCRIPTED, parse
from romnav.experiment.workspace import Workspace
from romnav.files import digest

if TYPE_CHECKING:
    from romnav.evaluation.rollout import Driver
    from romnav.evaluation.rowfile import Provenance
    from romnav.robot.dynamics import Body
    from romnav.world.world import World

NOISE, GUARD_NOISE, GAIT_NOISE = 1, 1000, 0
"""Seeds in evaluation, whatever the training seed: of the sensors' noise, the policy's and the safety filter's, so that
every arm meets the same noise in the same step of an episode, and of the gait in which a humanoid starts."""


@dataclass(frozen=True)
class Driven:
    """An arm that drives robots, with one training seed."""

    work: Workspace
    arm: str
    seed: int
    """0 for a scripted arm."""
    policy: Stage | None
    """What drives, if it is no script."""
    settings: Scale
    """Of the robots."""
    filtered: bool
    """Whether the safety filter guards them."""

    @classmethod
    def by(cls, work: Workspace, arm: str, seed: int) -> Driven:
        """The arm as it drives: its own policy or script, or another arm's on a body of its own.

        Raises:
            RomnavError: No experiment has this arm, or it cannot be trained or driven with these settings.
        """
        driver, script = work.project.driver(arm), work.project.script(arm)
        trained = None if script else policy(work, arm, seed)
        settings = work.arm_settings(driver) if trained else work.settings
        if arm not in SCRIPTED and (script or driver != arm):
            other = settings.on_body(work.arm_settings(arm).navigation)
            # together with the driver's settings: its period, too, has to be one of this body
            file = work.project.file(work.project.having(arm)[0])
            settings = parse(Scale, other.model_dump(mode="json"), file, f"arms.{arm}.")
        return cls(work, arm, seed if trained else 0, trained, settings, work.project.filtered(arm))

    @property
    def uses(self) -> tuple[str, ...]:
        """Settings that tell rows apart beside those of the policy."""
        robots: tuple[str, ...] = ("navigation.dynamics",)
        if self.settings.navigation.stair_limits is not None:
            robots += ("navigation.stair_limits",)
        if self.filtered:
            robots += ("safety.filter", "safety.sensor", "safety.corruption")
        if self.policy is None:
            return (*robots, "navigation.env")
        return robots if self.policy.arm != self.arm else ()

    @property
    def code(self) -> tuple[str, ...]:
        """The script, if it is from outside."""
        script = self.work.project.script(self.arm)
        return (DRIVERS.stamped(script),) if script and script not in SCRIPTED else ()

    @property
    def upstream(self) -> tuple[Stage, ...]:
        """The policy and what it needs, and what the robots need to walk."""
        above = (*self.policy.upstream, self.policy) if self.policy else ()
        present = {stage.name for stage in above}
        return (*(stage for stage in walking(self.work, self.settings) if stage.name not in present), *above)

    @property
    def cpu_only(self) -> bool:
        """Whether its robots have physics on the CPU alone."""
        return cpu_only(self.settings)

    @property
    def folder(self) -> Path:
        """Where the rows lie."""
        return self.work.folder / self.arm / f"seed-{self.seed}"

    def body(self, device: str) -> Body:
        """What makes the robots, behind the safety filter if it guards them."""
        settings = self.settings
        made = body(self.work, settings, GAIT_NOISE, device, settings.evaluation.threads)
        if not self.filtered:
            return made
        from romnav.evaluation.shield import Guarded

        arms = settings.locomotion.robot if settings.navigation.dynamics == "g1" else None
        # `safety.seed` is of the trials: episodes have a noise of their own, which no setting changes
        guard = settings.safety.model_copy(update={"seed": GUARD_NOISE})
        return partial(Guarded, made, guard, settings.navigation.env, arms)

    def driver(self, world: World, device: str) -> Driver:
        """What commands the robots."""
        from romnav.evaluation import rollout
        from romnav.navigation import checkpoint

        if self.policy is None:
            script = str(self.work.project.script(self.arm))
            made: Driver = rollout.SCRIPTED[script]() if script in SCRIPTED else DRIVERS.load(script)
            return made
        seen = perception(self.work, self.policy, self.settings, world, noise=NOISE, device=device)
        depth = seen.depth.encoder if seen.depth else None
        path = self.policy.folder / "policy.pt"
        return rollout.Policy(checkpoint.load_actor(path, seen.encoder, device, depth_encoder=depth), seen)

    def provenance(self, stage: Stage, starts: str, spec: EvaluationSpec | TrialSpec) -> Provenance:
        """Where the rows that a stage is about to make come from; ``starts`` is the hash of the initial conditions."""
        from romnav.evaluation.rowfile import Provenance

        facts: dict[str, Any] = {"steps": 0, "hours": 0.0}
        if self.policy and (record := records.read(self.policy)):
            facts = {name: record.facts.get(name, none) for name, none in facts.items()}
        source = records.provenance()
        return Provenance(
            scale=self.work.scale,
            commit=source["commit"],
            spec_hash=stage.key[:16],
            checkpoint_sha256=digest(self.policy.folder / "policy.pt") if self.policy else None,
            episode_set=starts,
            version=__version__,
            machine=source["machine"],
            duration=spec.duration,
            reach=spec.reach,
            **facts,
        )
