"""A project folder: its experiments, scales and results."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from romnav import parts
from romnav.errors import RomnavError
from romnav.experiment.spec import SCRIPTED, Experiment, load_experiments, parse, read_toml, suggest
from romnav.report.spec import PAIRED, Published


@dataclass(frozen=True)
class Project:
    """What is compared, and where the results lie."""

    root: Path
    """Folder with experiments/."""
    results: Path
    """Folder with one folder per scale."""

    @classmethod
    def here(cls, results: Path | None = None) -> Project:
        """The project that the current folder is in.

        Raises:
            RomnavError: There is none.
        """
        folder = Path.cwd()
        for root in (folder, *folder.parents):
            if (root / "experiments" / "scales").is_dir():
                parts.search(root)
                return cls(root, results or root / "results")
        raise RomnavError(f"{folder}: no experiments/ here or above; change to a project, or make one by `romnav init`")

    @property
    def worlds(self) -> Path:
        """Cache of what takes long to derive from terrain."""
        return self.root / ".cache" / "worlds"

    @cached_property
    def _read(self) -> tuple[dict[str, Experiment], dict[str, RomnavError]]:
        return load_experiments(self.root / "experiments")

    @property
    def experiments(self) -> dict[str, Experiment]:
        """Valid experiments by name."""
        return self._read[0]

    @property
    def faults(self) -> dict[str, RomnavError]:
        """What is wrong with the others, by name."""
        return self._read[1]

    def experiment(self, name: str) -> Experiment:
        """One experiment.

        Raises:
            RomnavError: There is none of this name, or it is invalid.
        """
        if name in self.faults:
            raise self.faults[name]
        if name not in self.experiments:
            raise RomnavError(f"unknown experiment {name}{suggest(name, self.experiments)}")
        return self.experiments[name]

    def file(self, experiment: str) -> Path:
        """The file of an experiment."""
        return self.root / "experiments" / f"{experiment}.toml"

    def published_files(self, experiment: str) -> tuple[Path, ...]:
        """The file of results that an experiment prints beside ours, if it names one.

        Raises:
            RomnavError: There is no such file.
        """
        name = self.experiment(experiment).published
        if name is None:
            return ()
        path = self.root / "experiments" / "published" / f"{name}.toml"
        if not path.exists():
            known = (file.stem for file in path.parent.glob("*.toml"))
            raise RomnavError(f"{self.file(experiment)}: published: no {path.name}{suggest(name, known)}")
        return (path,)

    def published(self, experiment: str) -> Published | None:
        """The results that an experiment prints beside ours.

        Raises:
            RomnavError: There is no such file, or it is invalid.
        """
        read = [parse(Published, read_toml(path), path) for path in self.published_files(experiment)]
        return read[0] if read else None

    @property
    def arms(self) -> set[str]:
        """Names of all arms, trained and scripted."""
        return {*SCRIPTED, *(name for experiment in self.experiments.values() for name in experiment.arms)}

    def having(self, arm: str) -> tuple[str, Experiment]:
        """An experiment that has a trained arm.

        Raises:
            RomnavError: None has it; if one is invalid, it may.
        """
        for name, experiment in self.experiments.items():
            if arm in experiment.arms:
                return name, experiment
        if arm in SCRIPTED:
            raise RomnavError(f"arm {arm} is a script: there is nothing to train; drive it by `romnav eval {arm}`")
        for fault in self.faults.values():
            raise fault
        raise RomnavError(f"unknown arm {arm}{suggest(arm, self.arms)}")

    def driver(self, arm: str) -> str:
        """The arm whose policy drives ``arm``: itself, unless it says otherwise.

        Raises:
            RomnavError: There is no such arm.
        """
        return arm if arm in SCRIPTED else self.having(arm)[1].driver(arm)

    def script(self, arm: str) -> str | None:
        """The scripted driver of an arm that has one in place of a policy.

        Raises:
            RomnavError: There is no such arm.
        """
        driver = self.driver(arm)
        return driver if driver in SCRIPTED else self.having(driver)[1].arms[driver].driver

    def filtered(self, arm: str) -> bool:
        """Whether the safety filter guards the robots of an arm.

        Raises:
            RomnavError: There is no such arm.
        """
        return arm not in SCRIPTED and self.having(arm)[1].arms[arm].filter

    def seeds(self, arm: str) -> tuple[int, ...]:
        """Training seeds of an arm; a scripted one has only seed 0."""
        return (0,) if self.script(arm) else self.having(arm)[1].seeds

    def comparisons(self, arms: Collection[str]) -> list[tuple[str, str]]:
        """Pairs of some arms: those of each experiment with its reference, or with the first that is among them."""
        pairs: dict[frozenset[str], tuple[str, str]] = {}
        for bounds in ((), SCRIPTED):  # below all others
            for experiment in self.experiments.values():
                found = [arm for arm in (experiment.compared_with, *experiment.arms) if arm in arms]
                for other in (arm for arm in (*found[1:], *bounds) if found and arm in arms and arm != found[0]):
                    pairs.setdefault(frozenset((found[0], other)), (found[0], other))
        return list(pairs.values())

    def overview(self) -> str:
        """Experiments, arms, and the training seeds evaluated at each scale, as text."""
        listed = {name: self._listed(name) for name in self.experiments}
        widths = [max((len(row[k]) for rows in listed.values() for row in rows), default=0) for k in (0, 1)]
        lines = []
        for name, experiment in self.experiments.items():
            lines.append(f"{name}: {experiment.title} ({experiment.kind})")
            for arm, label in listed[name]:
                lines.append(f"  {arm:<{widths[0]}}  {label:<{widths[1]}}  {self._evaluated(arm)}".rstrip())
        return "\n".join(lines)

    def _listed(self, name: str) -> list[tuple[str, str]]:
        """Arms of an experiment with what to call them, the scripted ones that bound its tables included."""
        experiment = self.experiments[name]
        bounds = SCRIPTED if experiment.declared(name, PAIRED).tables else ()
        return [*experiment.labels.items(), *((arm, "(scripted)") for arm in bounds)]

    def _evaluated(self, arm: str) -> str:
        found: dict[str, list[int]] = {}
        for file in sorted(self.results.glob(f"*/{arm}/seed-*/episodes.parquet")):
            if (seed := file.parts[-2].removeprefix("seed-")).isdecimal():
                found.setdefault(file.parts[-4], []).append(int(seed))
        return "; ".join(f"{scale}: seed {', '.join(map(str, seeds))}" for scale, seeds in found.items())
