"""An arm's episodes to look at: chosen by what happened in them, counted by how they fail, drawn as maps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import pandas as pd

from romnav.errors import RomnavError
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired.rows import HOW, WHERE, EpisodeRows
from romnav.evaluation.postures import Postures
from romnav.evaluation.tracks import Tracks
from romnav.report.paired.maps import draw_maps
from romnav.world.world import World


class EpisodeTable:
    """Rows of an arm; they need no terrain."""

    def __init__(self, run: EpisodeRows) -> None:
        self.run = run

    @cached_property
    def table(self) -> pd.DataFrame:
        """The rows with ``climb``, m."""
        table = pd.DataFrame(dict(self.run.columns))
        return table.assign(climb=(table.goal_z - table.spawn_z).abs())

    def choose(self, failed: bool, where: str | None) -> Sequence[int]:
        """Episodes that ``where``, an expression over the columns of the table, is true of.

        Raises:
            RomnavError: It is no such expression.
        """
        table = self.table[self.table.outcome != "success"] if failed else self.table
        if where:
            try:
                table = table.query(where)
            except Exception as error:  # whatever pandas makes of it, it is the user's expression
                columns = ", ".join(map(str, self.table.columns))
                raise RomnavError(f"--where {where!r}: {error}; columns are {columns}") from error
        return [int(episode) for episode in table.episode]

    def failures(self) -> pd.DataFrame:
        """Failed episodes by where the robot got (rows) and what it did in the end (columns)."""
        counts = pd.crosstab(self.table["where"], self.table["how"])
        return counts.reindex(index=list(WHERE), columns=list(HOW), fill_value=0)


class EpisodeGallery(EpisodeTable):
    """Rows and tracks of an arm on the terrain they are of, and a humanoid's postures if they were kept.

    The samples of tracks and postures are ``period`` seconds apart, the arm's own.
    """

    def __init__(
        self,
        run: EpisodeRows,
        tracks: Tracks,
        episodes: EpisodeSet,
        world: World,
        period: float,
        postures: Postures | None = None,
    ) -> None:
        super().__init__(run)
        self.tracks, self.episodes, self.world, self.postures = tracks, episodes, world, postures
        self.period = period

    def draw(self, chosen: Sequence[int], path: Path) -> None:
        """Draw maps of the chosen episodes and save them to ``path`` (type by its suffix)."""
        titles = {}
        for episode in chosen:
            row = self.table.loc[episode]
            end = f"{row['where']}, {row['how']}" if row["how"] else f"{row.success_time:.0f} s"
            titles[episode] = f"{episode}: {row.geodesic:.0f} m, climb {row.climb:.1f} m; {end}"
        draw_maps(self.world, self.episodes, self.tracks, titles, self.run.arm, path)
