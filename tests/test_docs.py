"""What the documentation says can be followed: links lead somewhere, commands exist, the tutorial is an experiment."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from romnav.cli import app
from romnav.experiment.kinds import reports
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [*DOCS, *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY"))]


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", prose) if "://" not in link]
    missing = [link for link in links if link[0] != "#" and not (page.parent / link.partition("#")[0]).exists()]
    assert not missing


def commands() -> Iterator[tuple[str, str]]:
    for page in PAGES:
        for block in re.findall(r"```\n(.*?)```", page.read_text(), flags=re.DOTALL):
            for line in block.replace("\\\n", "").splitlines():
                if found := re.search(r"^(?:\$ )?(?:\w+=\S+ )*romnav (.*)|\btorchrun .* -m romnav\.cli ([^']*)", line):
                    yield named(page), (found[1] or found[2]).partition("#")[0]


@pytest.mark.parametrize(("page", "line"), list(commands()))
def test_commands_are_there_and_take_their_options(page: str, line: str) -> None:
    command, words = typer.main.get_command(app), shlex.split(line)
    context = command.make_context("romnav", words)
    while hasattr(command, "commands"):
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        context = command.make_context(name, rest, parent=context)


def test_the_loop_for_slurm_submits_every_line_after_those_that_it_needs(tmp_path: Path) -> None:
    (loop,) = re.findall(r"```\n(declare .*?)```", (ROOT / "docs/scale.md").read_text(), flags=re.DOTALL)
    lines = ["romnav train policy rom # 1", "romnav eval rom # 2 after 1", "romnav run ablation pair # 3 after 1,2"]
    stand_ins = {
        "romnav": "printf '%s\\n' " + shlex.join(lines),
        "sbatch": 'echo "$@" >> jobs; expr 70 + $(wc -l < jobs)',
    }
    for name, text in stand_ins.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    subprocess.run(["bash", "-euc", loop], cwd=tmp_path, env={"PATH": f"{tmp_path}:{os.environ['PATH']}"}, check=True)
    jobs = [line.partition("yes ")[2] for line in (tmp_path / "jobs").read_text().splitlines()]
    assert jobs == [
        "--wrap romnav train policy rom",
        "--dependency=afterok:71 --wrap romnav eval rom",
        "--dependency=afterok:71:72 --wrap romnav run ablation pair",
    ]


def test_the_tutorials_experiment_is_one(tmp_path: Path) -> None:
    first, seeds, tables = re.findall(r"```toml[^\n]*\n(.*?)```", (ROOT / "docs/tutorial.md").read_text(), re.DOTALL)
    for name, text in {"plain": first, "seeds": seeds + first, "tables": first + tables}.items():
        shutil.copytree(ROOT / "experiments", tmp_path / name / "experiments")
        (tmp_path / name / "experiments" / "stair-starts.toml").write_text(text)
        project = Project(tmp_path / name, tmp_path / name / "results")
        work = Workspace(project, "smoke")
        (written,) = reports(work, "stair-starts", project.experiment("stair-starts").seeds)
        trained = {(s.arm, s.seed) for s in written.upstream if s.arm not in ("oracle", "straight")}
        assert len(trained) == (15 if name == "seeds" else 3)
        assert work.arm_settings("most").navigation.env.sampler.stair_probability == 0.7


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Links between pages and into the reference, too."""
    pytest.importorskip("mkdocs", reason="`pip install -e '.[docs]'`")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", tmp_path],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    assert (tmp_path / "reference" / "settings.html").stat().st_size > 100_000
