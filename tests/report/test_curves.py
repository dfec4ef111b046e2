"""Learning curves: window and interval against brute force and closed forms, times, figure, table, errors."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from romnav.errors import RomnavError
from romnav.report import curves, formats
from romnav.report.lines import COLOURS
from romnav.report.spec import Published

ITERATIONS = 30


def run(seed: int, slow_from: int = ITERATIONS) -> pd.DataFrame:
    """A run whose iterations take 2 s, from ``slow_from`` on 3 s, and now and then much longer."""
    rng = np.random.default_rng(seed)
    episodes = rng.integers(0, 9, ITERATIONS).astype(float)
    success = np.where(episodes > 0, rng.binomial(episodes.astype(int), 0.4) / np.maximum(episodes, 1), np.nan)
    spent = np.where(np.arange(ITERATIONS) < slow_from, 2.0, 3.0)
    spent[::11] = 50.0
    iteration = np.arange(1, ITERATIONS + 1)
    columns = {"iteration": iteration, "steps": 1000 * iteration, "cpu_seconds": spent.cumsum()}
    return pd.DataFrame(columns | {"episodes": episodes, "success": success})


@pytest.fixture
def arms() -> dict[str, curves.Curves]:
    half = ITERATIONS // 2
    return {
        "frozen": curves.Curves("Frozen", 1.0, tuple(map(run, range(3)))),
        "unfrozen": curves.Curves("Unfrozen @ half", 0.5, tuple(run(k, half) for k in range(3, 6))),
        "scratch": curves.Curves("No Pretraining", 0.0, tuple(run(k, 0) for k in range(6, 9))),
    }


def test_the_window_weighs_episodes_not_iterations(arms: dict[str, curves.Curves]) -> None:
    smooth = arms["frozen"].smooth()
    for seed, frame in enumerate(arms["frozen"].seeds):
        for end in range(ITERATIONS):
            part = frame.iloc[max(0, end - 2) : end + 1]
            solved, finished = (part["success"].fillna(0.0) * part["episodes"]).sum(), part["episodes"].sum()
            expected = 100 * solved / finished if finished else math.nan
            assert smooth[seed, end] == pytest.approx(expected, nan_ok=True)
    assert arms["frozen"].final().value == pytest.approx(smooth[:, -1].mean())


@pytest.mark.parametrize("spread", [0.0, 0.15])
def test_the_interval_holds_both_levels(spread: float) -> None:
    """Its half width is 1.96 deviations of the mean: between seeds, and of the episodes within."""
    seeds, episodes = 40, 200
    rate = 0.5 + spread * np.linspace(-1, 1, seeds)
    found = curves.two_level(rate * episodes, np.full(seeds, float(episodes)))
    variance = rate.var() / seeds + np.mean(rate * (1 - rate)) / episodes / seeds
    assert found.value == pytest.approx(50.0)
    assert (found.hi - found.lo) / 2 == pytest.approx(196 * math.sqrt(variance), rel=0.05)
    assert found.n == seeds * episodes
    assert math.isnan(curves.two_level(np.array([1.0, 0.0]), np.array([2.0, 0.0])).value)


def test_iteration_times_are_of_the_phases_and_shrug_off_outliers(arms: dict[str, curves.Curves]) -> None:
    assert arms["frozen"].iteration_time(unfrozen=False) == 2.0
    assert math.isnan(arms["frozen"].iteration_time(unfrozen=True))
    assert arms["unfrozen"].iteration_time(unfrozen=False) == 2.0
    assert arms["unfrozen"].iteration_time(unfrozen=True) == 3.0
    assert arms["scratch"].iteration_time(unfrozen=True) == 3.0


def test_the_table_has_our_rows_and_the_papers(arms: dict[str, curves.Curves]) -> None:
    paper = Published(title="Paper", arms={"frozen": {"iteration_time": 1.0}, "unfrozen": {"iteration_time": 1.15}})
    provenance, sources = {"scale": "smoke", "commit": "abc"}, dict.fromkeys(arms, ())
    table = curves.tabulate("pretrain", "Encoder.", arms, provenance, sources, paper)
    ours, published = table.blocks
    assert [row.label for row in ours.rows] == ["Frozen", "Unfrozen @ half", "No Pretraining"]
    assert [row.cells[2].text for row in ours.rows] == ["1.00", "1.50", "1.50"]
    assert [row.cells[2].text for row in published.rows] == ["1.00", "1.15"]
    final = arms["unfrozen"].final()
    assert ours.rows[1].cells[1].text == f"{final.lo:.1f} to {final.hi:.1f}"
    assert final.lo < ours.rows[1].cells[0].value < final.hi
    assert "training seeds per arm: 3" in table.caption
    assert table.caption.endswith("commit abc. Paper: as published, wall-clock time on a GPU.")
    alone = curves.tabulate("pretrain", "Encoder.", arms, provenance, sources)
    assert (len(alone.blocks), alone.caption[-4:]) == (1, "abc.")
    for render in (formats.latex, formats.markdown, formats.to_csv):
        assert "No Pretraining" in render(table)


def test_the_figure_is_drawn(arms: dict[str, curves.Curves], tmp_path: Path) -> None:
    path = tmp_path / "figures" / "curves.png"
    costly = replace(arms["frozen"], label=r"$5, \frac$ of $_")  # no formula
    curves.draw(arms | {"frozen": costly}, path)
    image = matplotlib.image.imread(path)[..., :3]
    blank = (image == 1.0).all(axis=2).mean()
    assert 0.3 < blank < 0.99


def test_every_arm_is_drawn_in_a_look_of_its_own(
    arms: dict[str, curves.Curves], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: saved.append(figure))
    labels = [f"arm {k}" for k in range(len(COLOURS) + 2)]
    curves.draw({label: replace(arms["frozen"], label=label) for label in labels}, tmp_path / "curves.png")
    (axes,) = saved[0].axes
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == labels
    assert len({(line.get_color(), line.get_linestyle()) for line in axes.lines}) == len(labels)


def test_curves_are_read_whole_or_refused(tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.csv" for k in range(3)]
    for k, file in enumerate(files):
        run(k).to_csv(file, index=False)
    read = curves.read("Frozen", 1.0, files)
    pd.testing.assert_frame_equal(read.seeds[1], run(1).astype(float))
    run(2).iloc[:-1].to_csv(files[2], index=False)
    with pytest.raises(RomnavError, match=r"2\.csv: 29 iterations, but .*0\.csv has 30; train the arm again"):
        curves.read("Frozen", 1.0, files)
    run(2).drop(columns="cpu_seconds").to_csv(files[2], index=False)
    with pytest.raises(RomnavError, match=r"2\.csv: no learning curve \(.*cpu_seconds.*\); train the arm again"):
        curves.read("Frozen", 1.0, files)
    with pytest.raises(RomnavError, match=r"gone\.csv: no learning curve"):
        curves.read("Frozen", 1.0, [tmp_path / "gone.csv"])
