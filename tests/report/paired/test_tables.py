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
from romnav.experiment.project import Project
from romnav.report import formats
from romnav.report.paired import tables
from romnav.report.spec import PAIRED, Published, TableSpec

ROOT = Path(__file__).parents[3]
PROJECT = Project(ROOT, ROOT / "results")
DECLARED = {
    name: declared
    for experiment in ("spawn-goal", "kickstart")
    for name, declared in PROJECT.experiment(experiment).declared(experiment, PAIRED).tables.items()
}


def published() -> Published:
    found = PROJECT.published("spawn-goal")
    assert found
    return found


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
def built(arms, papers_tables) -> dict[str, formats.Table]:
    return papers_tables(arms)


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


def test_every_table_of_the_paper_is_declared(built) -> None:
    spawn_goal = [f"spawngoal-{kind}-rom" for kind in ("perf", "levels", "success", "failures")]
    assert list(built) == [*spawn_goal, "nav-perf", "nav-levels", "nav-failures", "nav-classes", "nav-success"]


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
    cross, paper = 488 / 1024, published()
    for arm in ("rom-nav", "rom-hum", "single-stage"):
        of = paper.arms[arm]
        assert cross * of["sr_120_cross"] + (1 - cross) * of["sr_120_same"] == pytest.approx(of["sr_120"], abs=0.2)
        if arm != "single-stage":
            assert of["sr_120_cross"] == pytest.approx(100.0 - of["falls_cross"] - of["timeouts_cross"], abs=0.05)
        if arm != "rom-nav":
            for metric in ("sr_120_same", "sr_120_cross"):
                difference = paper.arms["rom-nav"][metric] - of[metric]
                assert difference == pytest.approx(paper.contrasts["rom-nav"][arm][metric].diff, abs=0.15)


def build_of(name: str, *runs: rows.EpisodeRows, spec: TableSpec | None = None) -> formats.Table:
    bootstrap = Bootstrap(rows.pair(runs), resamples=50)
    return tables.build(name, spec or DECLARED[name], "Title", bootstrap, published())


def test_ties_share_the_bold(episode_rows) -> None:
    a = episode_rows("rom")
    b = rows.make({**a.columns, "arm": ["uniform"] * len(a)}, a.provenance)
    table = build_of("spawngoal-perf-rom", a, b)
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
            c = bootstrap.contrast("rom", "uniform", f"sr_{horizon}", level)
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
    c = Bootstrap(arms).contrast("rom", "uniform", "sr_120", "cross")
    assert (float(line["value"]), float(line["lo"]), float(line["hi"])) == (c.diff, c.lo, c.hi)
    assert (int(line["n"]), bool(int(line["dagger"]))) == (c.n, c.significant)
    assert (int(line["a_only"]), int(line["b_only"]), float(line["mid_p"])) == (c.a_only, c.b_only, c.mid_p)
    assert (line["scale"], line["episode_set"]) == ("cpu_&_%", "feedc0ffee123456")
    published = [x for x in lines if x["source"] == "paper"]
    assert len(published) == 12
    assert not any(x["lo"] or x["commit"] for x in published)


def test_negative_zero_is_zero() -> None:
    assert formats.number(-0.04, 1, sign=True).text == "+0.0"


def test_a_table_needs_one_of_its_arms(episode_rows) -> None:
    uniform = episode_rows("uniform")
    with pytest.raises(RomnavError, match=r"table nav-levels: no arm .* evaluate rom-nav first"):
        build_of("nav-levels", uniform)
    with pytest.raises(RomnavError, match=r"table nav-perf: no arm .* evaluate rom first"):
        build_of("nav-perf", episode_rows("oracle-hum"))  # a bound alone
    lone = build_of("spawngoal-levels-rom", uniform)  # the reference is missing: nothing to subtract from
    assert {cell.text for r in lone.blocks[0].rows for cell in r.cells} == {"–"}
    assert row(read_latex(formats.latex(lone)), "RoM $-$ Uniform") == ["--"] * 4


def test_the_caption_of_untrained_arms_says_nothing_of_training(episode_rows) -> None:
    spec = DECLARED["spawngoal-perf-rom"].model_copy(update={"rows": (DECLARED["spawngoal-perf-rom"].bounds,)})
    caption = build_of("bounds", episode_rows("oracle", steps=0), spec=spec).caption
    assert "This work: smoke scale, 64 paired episodes of set" in caption
    assert "training" not in caption[caption.index("This work") :]


OWN = """
kind = "ablation"
title = "Mine"
reference = "b"
[arms.a]
label = "A"
[arms.b]
label = "B"
"""


def own(tmp_path: Path, more: str = "") -> dict[str, TableSpec]:
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments" / "own.toml").write_text(OWN + more)
    return Project(tmp_path, tmp_path).experiment("own").declared("own", PAIRED).tables


def test_labels_alone_give_tables(tmp_path: Path, episode_rows) -> None:
    specs = own(tmp_path)
    assert list(specs) == ["own", "own-contrasts"]
    runs = [episode_rows("a"), episode_rows("b", 0.2), episode_rows("oracle", 1.0, steps=0)]
    bootstrap = Bootstrap(rows.pair(runs), resamples=50)
    arms, contrasts = (tables.build(name, spec, "Mine", bootstrap) for name, spec in specs.items())
    assert [r.label for block in arms.blocks for r in block.rows] == ["A", "B", "Oracle"]
    assert arms.header == ("Arm", "SR@45 (%)", "SR@120 (%)", "T2G (s)", "SPL")
    assert arms.caption.startswith("Mine. SR@45: success within 45 s; SR@120:")
    assert [r.label for block in contrasts.blocks for r in block.rows] == ["B − A", "B − Oracle"]
    assert contrasts.caption.startswith("Mine: paired differences of B to each other arm.")
    assert "Paper" not in arms.caption + contrasts.caption
    assert {block.source for block in (*arms.blocks, *contrasts.blocks)} == {"ours"}


def test_any_metric_is_a_column_and_can_be_contrasted(tmp_path: Path, episode_rows) -> None:
    columns = 'columns = ["collisions", "falls_cross", { metric = "spl", header = "Way" }]\n'
    declared = f'[tables.mine]\nrows = ["b"]\n{columns}[tables.less]\nkind = "contrasts"\n{columns}'
    specs = own(tmp_path, declared)
    a, b = episode_rows("a"), episode_rows("b", 0.2)
    bootstrap = Bootstrap(rows.pair([a, b]), resamples=50)
    mine, less = (tables.build(name, spec, "Mine", bootstrap) for name, spec in specs.items())
    headers = ("Contact (per 100 m)", "Falls, cross (%)", "Way")
    assert (mine.header, less.header) == (("Arm", *headers), ("Contrast", *headers))
    assert less.spans == ()
    of_a, of_b = (metrics.evaluate(run.columns) for run in (a, b))
    assert mine.blocks[0].rows[0].cells[2].text == f"{of_b['spl']:.3f}"
    assert less.blocks[0].rows[0].cells[2].value == pytest.approx(of_b["spl"] - of_a["spl"])
    falls = less.blocks[0].rows[0].cells[1].facts
    fell = [(run.columns["outcome"] == "fall") & (run.columns["level"] == "cross") for run in (b, a)]
    assert (falls["a_only"], falls["b_only"]) == ((fell[0] & ~fell[1]).sum(), (fell[1] & ~fell[0]).sum())


def test_every_metric_has_a_name_and_a_meaning() -> None:
    for name in tables.known_metrics("performance"):
        assert tables.meaning(name).definition
    assert tables.known_metrics("performance")[-2:] == ["steps", "hours"]
    assert "steps" not in tables.known_metrics("contrasts")


def test_every_arm_that_competes_has_published_numbers() -> None:
    paper = published()
    for spec in DECLARED.values():
        arms = {entry.arm for block in spec.rows for entry in block}
        assert arms <= paper.arms.keys()
        if spec.kind == "contrasts":
            assert arms <= paper.contrasts[spec.reference.arm].keys()


def test_published_contrasts_lie_between_their_levels() -> None:
    """The published overall difference is a mean of the published differences of both levels."""
    paper = published()
    for a, others in paper.contrasts.items():
        for b, by in others.items():
            for metric in ("sr_45", "sr_120"):
                difference = paper.arms[a][metric] - paper.arms[b][metric]
                low, high = sorted(by[f"{metric}_{level}"].diff for level in ("same", "cross"))
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
