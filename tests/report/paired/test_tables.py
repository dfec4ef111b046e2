from __future__ import annotations

import csv
import io
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from romnav.errors import RomnavError
from romnav.evaluation.paired import metrics, rows
from romnav.evaluation.paired.statistics import Bootstrap
from romnav.report import formats, paper
from romnav.report.paired import tables

SKILLS = {
    "rom": 0.95,
    "uniform": 0.6,
    "nocap": 0.9,
    "uniform-nocap": 0.5,
    "oracle": 1.0,
    "straight": 0.1,
    "rom-nav": 0.9,
    "rom-hum": 0.7,
    "single-stage": 0.5,
}


@pytest.fixture(scope="module")
def arms(episode_rows) -> list[rows.Arm]:
    steps = {"oracle": 0, "straight": 0}
    return rows.pair(
        episode_rows(
            arm,
            skill,
            n=256,
            steps=steps.get(arm, 1_500_000),
            scale="cpu_&_%",
            commit=f"{'0123456789' * 4}-dirty",
        )
        for arm, skill in SKILLS.items()
    )


@pytest.fixture(scope="module")
def built(arms) -> dict[str, formats.Table]:
    return {table.name: table for table in tables.build_all(arms)}


def read_latex(text: str) -> list[list[str]]:
    """Cells of a booktabs table, by a parser that knows nothing of the writer; fails where LaTeX would."""
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    body = "\n".join(lines)
    open_environments: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", body):
        if kind == "begin":
            open_environments.append(name)
        else:
            assert open_environments.pop() == name
    assert not open_environments
    depth = 0
    for character in re.sub(r"\\[{}]", "", body):
        depth += {"{": 1, "}": -1}.get(character, 0)
        assert depth >= 0
    assert depth == 0
    assert body.isascii()
    assert len(re.findall(r"(?<!\\)\$", body)) % 2 == 0
    start = re.search(r"\\begin\{tabular\}\{(.*)\}\n", body)
    assert start
    columns = len(re.sub(r"@\{(?:[^{}]|\{[^{}]*\})*\}", "", start[1]))
    caption = re.search(r"\\caption\{(.*)\}\n", body)
    assert caption
    assert not re.search(r"(?<!\\)[&%#_]", caption[1])
    inside = body[start.end() : body.index(r"\end{tabular}")]
    inside = re.sub(r"\\(top|mid|bottom)rule|\\addlinespace|\\cmidrule\(lr\)\{\d-\d\}", "", inside)
    found = []
    for row in inside.split(r"\\"):
        if row.strip():
            cells = [cell.strip() for cell in re.split(r"(?<!\\)&", row)]
            spanned = sum(int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d)\}", row))
            assert len(cells) + spanned == columns
            found.append(cells)
    return found


def row(cells: list[list[str]], label: str, nth: int = 0) -> list[str]:
    return [line for line in cells if line[0] == label][nth][1:]


def test_every_table_is_built(built) -> None:
    navigation = ["nav-perf", "nav-levels", "nav-failures", "nav-success"]
    assert list(built) == ["spawngoal-perf-rom", "spawngoal-levels-rom", *navigation, "spawngoal-success-rom"]


def test_performance_table(built, arms) -> None:
    cells = read_latex(formats.latex(built["spawngoal-perf-rom"]))
    labels = [line[0] for line in cells]
    ablation = ["RoM", "Uniform", "NoCap", "UniformNoCap"]
    assert labels[0] == "Arm"
    assert labels[2:8] == [*ablation, "Oracle", "Straight"]
    assert labels[9:] == ablation
    assert cells[1][0] == r"\multicolumn{5}{@{}l}{\emph{This work, cpu\_\&\_\% scale}}"
    # The paper's group is its table, bold included.
    assert row(cells, "RoM", 1) == [r"\textbf{84.1}", r"\textbf{93.6}", "25.6", r"\textbf{0.776}"]
    assert row(cells, "NoCap", 1) == ["69.8", "75.8", "22.9", "0.624"]
    m = metrics.evaluate(arms[1].runs[0].columns)
    assert row(cells, "Uniform") == [
        f"{m['sr_45']:.1f}",
        f"{m['sr_120']:.1f}",
        f"{m['t2g']:.1f}",
        f"{m['spl']:.3f}",
    ]


def test_bold_is_the_best_competing_arm_and_never_the_time_of_the_ablation(built) -> None:
    ablation = built["spawngoal-perf-rom"].blocks
    competing, bounds = ablation[0].rows, ablation[1].rows
    assert not any(cell.bold for bound in bounds for cell in bound.cells)
    for k, bold in enumerate((True, True, False, True)):
        best = max(float(r.cells[k].text) for r in competing)
        assert [r.cells[k].bold for r in competing] == [bold and float(r.cells[k].text) == best for r in competing]
    cyl, humanoid = built["nav-perf"].blocks[:2]
    assert not any(cell.bold for cell in cyl.rows[0].cells)
    times = [float(r.cells[2].text) for r in humanoid.rows]
    assert [r.cells[2].bold for r in humanoid.rows] == [t == min(times) for t in times]


def test_failures_by_level_and_costs_of_training(built, arms) -> None:
    cells = read_latex(formats.latex(built["nav-failures"]))
    of = {arm.name: arm.runs[0].columns for arm in arms}
    columns = of["rom-nav"]
    expected = [
        f"{100 * (columns['outcome'][columns['level'] == level] == outcome).mean():.1f}"
        for outcome in ("fall", "timeout")
        for level in ("same", "cross")
    ]
    assert [re.sub(r"\\textbf{(.*)}", r"\1", cell) for cell in row(cells, "RoM-Nav")] == expected
    assert row(cells, "RoM-Nav", 1) == ["--", r"\textbf{8.3}", "--", r"\textbf{3.7}"]
    perf = read_latex(formats.latex(built["nav-perf"]))
    assert row(perf, "RoM-Nav")[-2:] == ["1.5", "0.2"]
    assert row(perf, "RoM-Nav", 1)[-2:] == ["--", "32.0"]


def test_success_by_level(built, arms) -> None:
    of = {arm.name: arm.runs[0].columns for arm in arms}
    for name, arm, label in (("nav-success", "rom-hum", "RoM (hum)"), ("spawngoal-success-rom", "nocap", "NoCap")):
        cells = read_latex(formats.latex(built[name]))
        c = of[arm]
        expected = [
            f"{100 * (c['success_time'][c['level'] == level] <= horizon).mean():.1f}"
            for horizon in (45, 120)
            for level in ("same", "cross")
        ]
        assert [re.sub(r"\\textbf{(.*)}", r"\1", cell) for cell in row(cells, label)] == expected
    assert row(read_latex(formats.latex(built["nav-success"])), "RoM (hum)", 1) == ["--", "--", "96.6", "78.8"]
    sources = {block.source for block in built["spawngoal-success-rom"].blocks}
    assert sources == {"ours"}  # the paper gives no rates by level for these arms


def test_published_success_by_level_follows_from_what_the_paper_states() -> None:
    cross = 488 / 1024
    for arm in ("rom-nav", "rom-hum", "single-stage"):
        of = paper.PERFORMANCE[arm]
        assert cross * of["sr_120_cross"] + (1 - cross) * of["sr_120_same"] == pytest.approx(of["sr_120"], abs=0.2)
        if arm != "single-stage":
            assert of["sr_120_cross"] == pytest.approx(100.0 - of["falls_cross"] - of["timeouts_cross"], abs=0.05)
        if arm != "rom-nav":
            for level in ("same", "cross"):
                difference = paper.PERFORMANCE["rom-nav"][f"sr_120_{level}"] - of[f"sr_120_{level}"]
                assert difference == pytest.approx(paper.CONTRASTS["rom-nav", arm][120, level][0], abs=0.15)


def test_ties_share_the_bold(episode_rows) -> None:
    a = episode_rows("rom")
    b = rows.make({**a.columns, "arm": ["uniform"] * len(a)}, a.provenance)
    table = tables.build_all(rows.pair([a, b]))[0]
    assert [r.cells[0].bold for r in table.blocks[0].rows] == [True, True, False, False]
    assert [r.cells[0].text for r in table.blocks[0].rows][2:] == ["–", "–"]


def test_levels_table(built, arms) -> None:
    cells = read_latex(formats.latex(built["spawngoal-levels-rom"]))
    assert cells[0] == ["", r"\multicolumn{2}{c}{45\,s}", r"\multicolumn{2}{c}{120\,s}"]
    dagger = r"\rlap{\textsuperscript{$\dagger$}}"
    assert row(cells, "RoM $-$ NoCap", 1) == ["$-0.6$", f"$+30.7${dagger}", "$-0.2$", f"$+37.7${dagger}"]
    bootstrap = Bootstrap(arms)
    expected = []
    for horizon in (45, 120):
        for level in ("same", "cross"):
            c = bootstrap.contrast("rom", "uniform", horizon, level)
            expected.append(f"${c.diff:+.1f}${dagger if c.significant else ''}")
    assert row(cells, "RoM $-$ Uniform") == expected
    assert [line[0] for line in cells].count("RoM $-$ Oracle") == 1


def test_the_caption_names_scale_commit_and_episode_set(built) -> None:
    for table in built.values():
        assert "cpu_&_% scale" in table.caption
        assert "commit 012345678901-dirty." in table.caption
        assert "256 paired episodes of set feedc0ffee12" in table.caption
        assert "% episode_set: feedc0ffee123456\n" in formats.latex(table)


def test_markdown_shows_the_same_numbers(built) -> None:
    for table in built.values():
        text = formats.markdown(table)
        lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in text.splitlines() if line.startswith("|")]
        assert {len(line) for line in lines} == {len(table.header)}
        shown = [[cell.strip() for cell in line] for line in lines[2:]]
        shown = [line[1:] for line in shown if any(line[1:])]
        expected = [[c.text.replace("-", "−") for c in r.cells] for b in table.blocks for r in b.rows]
        assert [[re.sub(r"[*†]", "", cell) for cell in line] for line in shown] == expected


def test_csv_holds_unrounded_numbers_with_intervals(built, arms) -> None:
    text = formats.to_csv(built["spawngoal-levels-rom"])
    lines = list(csv.DictReader(io.StringIO(text)))
    wanted = {"source": "ours", "row": "RoM − Uniform", "column": "sr_120_cross"}
    (line,) = [x for x in lines if wanted.items() <= x.items()]
    c = Bootstrap(arms).contrast("rom", "uniform", 120, "cross")
    assert (float(line["value"]), float(line["lo"]), float(line["hi"])) == (c.diff, c.lo, c.hi)
    assert (int(line["n"]), bool(int(line["dagger"]))) == (c.n, c.significant)
    assert (int(line["a_only"]), int(line["b_only"]), float(line["mid_p"])) == (c.a_only, c.b_only, c.mid_p)
    assert (line["scale"], line["episode_set"]) == ("cpu_&_%", "feedc0ffee123456")
    published = [x for x in lines if x["source"] == "paper"]
    assert len(published) == 12
    assert not any(x["lo"] or x["commit"] for x in published)


def test_negative_zero_is_zero() -> None:
    assert formats.number(-0.04, 1, sign=True).text == "+0.0"


def test_no_table_without_its_reference_arm(episode_rows) -> None:
    with pytest.raises(RomnavError, match="evaluate rom or rom-nav and another arm"):
        tables.build_all(rows.pair([episode_rows("uniform"), episode_rows("nocap")]))
    with pytest.raises(RomnavError, match="another arm"):
        tables.build_all(rows.pair([episode_rows("rom")]))


def test_a_table_needs_one_of_its_arms(episode_rows) -> None:
    bootstrap = Bootstrap(rows.pair([episode_rows("uniform")]))
    with pytest.raises(RomnavError, match=r"table nav-levels: no arm .* evaluate rom-nav first"):
        tables.build(tables.SPECS[3], bootstrap)
    lone = tables.build(tables.SPECS[1], bootstrap)  # the reference is missing: nothing to subtract from
    assert {cell.text for r in lone.blocks[0].rows for cell in r.cells} == {"–"}
    assert row(read_latex(formats.latex(lone)), "RoM $-$ Uniform") == ["--"] * 4


def test_arms_that_the_paper_has_no_numbers_of_are_dashes_there(episode_rows) -> None:
    mine = tables.Entry("mine", "Mine")
    rom = tables.Entry("rom", "RoM")
    columns = (tables.Column("sr_45", "SR@45", 1, max),)
    bootstrap = Bootstrap(rows.pair([episode_rows("rom"), episode_rows("mine", 0.2)]), resamples=50)
    performance = tables.build(tables.PerformanceSpec("own", "Own.", rom, ((rom, mine),), columns), bootstrap)
    levels = tables.build(tables.LevelsSpec("own-levels", "Own.", rom, (mine,)), bootstrap)
    for table in (performance, levels):
        ours, paper_ = ([row.cells[0].text for row in b.rows] for b in table.blocks)
        assert paper_[-1] == "–" != ours[-1]


def test_every_arm_that_competes_has_published_numbers() -> None:
    for spec in tables.SPECS:
        arms = [entry.arm for entry in spec.entries if entry not in spec.bounds]
        assert set(arms) <= set(paper.PERFORMANCE)
        if isinstance(spec, tables.LevelsSpec):
            assert {(spec.reference.arm, other.arm) for other in spec.others} <= set(paper.CONTRASTS)


def test_published_contrasts_lie_between_their_levels() -> None:
    """The published overall difference is a mean of the published differences of both levels."""
    for (a, b), by in paper.CONTRASTS.items():
        for horizon in (45, 120):
            difference = paper.PERFORMANCE[a][f"sr_{horizon}"] - paper.PERFORMANCE[b][f"sr_{horizon}"]
            low, high = sorted(by[horizon, level][0] for level in ("same", "cross"))
            assert low <= difference <= high


@pytest.mark.skipif(not shutil.which("pdflatex"), reason="no LaTeX on this machine; read_latex checks the structure")
def test_the_tables_compile(built, tmp_path: Path) -> None:
    for table in built.values():
        formats.write(table, tmp_path)
    inputs = "\n".join(rf"\input{{{name}}}" for name in built)
    document = (
        r"\documentclass[letterpaper,10pt,twocolumn]{article}\usepackage{booktabs}\textwidth=7.1in\begin{document}"
        f"\n{inputs}\n\\end{{document}}\n"
    )
    (tmp_path / "document.tex").write_text(document)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "document.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout
    assert (tmp_path / "document.pdf").stat().st_size > 0
