from __future__ import annotations

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import pytest

from romnav.evaluation.paired import rows
from romnav.report.page.render import Report, write
from romnav.report.paired.gallery import EpisodeGallery


class Page(HTMLParser):
    """Buttons, data and addresses of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.buttons: list[dict[str, str | None]] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag == "button" and "number" in (found.get("class") or ""):
            self.buttons.append(found)
        self.addresses += [found[key] or "" for key in ("src", "href") if key in found]


@pytest.fixture(scope="module")
def text(
    episode_rows: Callable[..., rows.EpisodeRows],
    galleries: dict[str, EpisodeGallery],
    papers_tables: Callable,
    tmp_path_factory: pytest.TempPathFactory,
) -> str:
    made = [episode_rows(arm, skill) for arm, skill in {"rom": 0.8, "uniform": 0.6}.items()]
    path = tmp_path_factory.mktemp("page") / "report.html"
    write(Report("smoke", [*papers_tables(rows.pair(made)).values()], {}, galleries, ("a <b>note</b>",)), path)
    return path.read_text("utf-8")


def data(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


def test_it_needs_nothing_from_elsewhere(text: str) -> None:
    assert all(address.startswith(("#", "data:")) for address in Page(text).addresses)
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest|importScripts", text)


def test_every_number_of_ours_leads_to_its_rows(text: str) -> None:
    sources, buttons = data(text)["sources"], Page(text).buttons
    assert {source["file"] for source in sources} == {"rom/seed-0", "uniform/seed-0"}
    assert all(source["commit"] and source["machine"] and source["spec_hash"] for source in sources)
    assert buttons
    for button in buttons:
        files = [sources[int(k)]["file"] for k in (button["data-source"] or "").split()]
        label = (button["data-name"] or "").split(",")[0]
        assert files == {
            "RoM": ["rom/seed-0"], "Uniform": ["uniform/seed-0"], "RoM − Uniform": ["rom/seed-0", "uniform/seed-0"],
        }[label]  # fmt: skip
        assert json.loads(button["data-facts"] or "")["value"] is not None


def test_intervals_hold_their_values(text: str) -> None:
    found = data(text)["intervals"]
    assert {"SR@45 (%)", "45 s, cross"} <= {column["title"] for column in found}
    for row in (row for column in found for row in column["rows"]):
        assert row["lo"] is None or row["lo"] <= row["value"] <= row["hi"]


def test_what_users_name_is_text_and_not_markup(text: str) -> None:
    assert "a &lt;b&gt;note&lt;/b&gt;" in text


def test_a_folder_that_cannot_be_written_is_one_error(tmp_path: Path) -> None:
    from romnav.errors import RomnavError

    (tmp_path / "file").write_text("")
    with pytest.raises(RomnavError, match="cannot be written"):
        write(Report("smoke", [], {}, {}), tmp_path / "file" / "report.html")
