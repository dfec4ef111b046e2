"""A project at one scale: where stages lie, and with which settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from romnav.experiment.project import Project
from romnav.experiment.scales import Scale, ScaleFile, find


@dataclass(frozen=True)
class Workspace:
    """A project at one scale.

    Raises:
        RomnavError: There is no such scale; its file is invalid, where a setting is first needed.
    """

    project: Project
    scale: str
    """Name of the scale."""

    def __post_init__(self) -> None:
        find(self._scales, self.scale)  # what only reads results asks for no setting

    @property
    def _scales(self) -> Path:
        return self.project.root / "experiments" / "scales"

    @cached_property
    def _file(self) -> ScaleFile:
        return ScaleFile(self._scales, self.scale)

    @property
    def settings(self) -> Scale:
        """The settings of the scale."""
        return self._file.settings

    def body_settings(self, body: str) -> Scale:
        """The scale's settings for a body."""
        return self._file.of_body(body)

    def arm_settings(self, arm: str) -> Scale:
        """The scale's settings with the changes of a trained arm.

        Raises:
            RomnavError: No experiment has this arm, or its changes are invalid.
        """
        name, experiment = self.project.having(arm)
        return self._file.changed(arm, experiment, self.project.file(name))

    @property
    def folder(self) -> Path:
        """Results of this scale."""
        return self.project.results / self.scale

    def command(self, *words: str) -> tuple[str, ...]:
        """A ``romnav`` command here, without that word."""
        elsewhere = self.project.results != self.project.root / "results"
        return (*words, "--scale", self.scale, *(("--results", str(self.project.results)) if elsewhere else ()))
