"""The report in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from romnav.report.page.render import Report, write
from tests.report.browser import chromium, watch
from tests.report.conftest import Walk

pytestmark = pytest.mark.slow
COUNT = 1024
TIMEOUT = 120_000


@pytest.fixture(scope="module")
def page(walk: Walk, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    path = tmp_path_factory.mktemp("page") / "report.html"
    with chromium() as browser:
        write(Report("smoke", [], {}, walk(COUNT)), path)
        page = browser.new_page(viewport={"width": 1100, "height": 800})
        page.set_default_timeout(TIMEOUT)
        errors, asked = watch(page)
        page.goto(path.as_uri())
        yield page
        assert errors == []
        assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []


def column(page: Any, index: int) -> list[str]:
    return page.locator(f".episodes tbody td:nth-child({index})").all_inner_texts()


def test_all_episodes_are_there_and_sort_both_ways(page: Any) -> None:
    assert page.locator(".episodes tbody tr").count() == COUNT
    for descending in (False, True):
        page.locator('th[data-key="geodesic"] button').click()
        lengths = [float(text) for text in column(page, 4)]
        assert lengths == sorted(lengths, reverse=descending)
    sort = page.locator('th[data-key="geodesic"]').get_attribute("aria-sort")
    assert sort == "descending"


def test_filters_leave_what_passes_all_of_them(page: Any) -> None:
    page.select_option("select[name=level]", "cross")
    page.fill("input[name=climb]", "3.5")
    levels, climbs = column(page, 3), column(page, 5)
    assert 0 < len(levels) < COUNT
    assert set(levels) == {"cross"}
    assert min(map(float, climbs)) >= 3.5
    page.get_by_role("button", name="Clear").click()
    page.wait_for_function(f"document.querySelectorAll('.episodes tbody tr').length === {COUNT}")


def test_a_count_of_failures_shows_those_episodes(page: Any) -> None:
    button = page.locator("#failures button.count").first
    number = int(button.inner_text())
    button.click()
    assert page.locator(".episodes tbody tr").count() == number
    page.get_by_role("button", name="Clear").click()


def test_scrolling_through_all_episodes_is_smooth(page: Any) -> None:
    gaps = page.evaluate(
        """async () => {
            const box = document.querySelector(".tall"), gaps = [];
            let last = performance.now();
            for (let k = 0; k < 60; k++) {
                box.scrollTop = (box.scrollHeight * k) / 60;
                await new Promise(requestAnimationFrame);
                gaps.push(performance.now() - last);
                last = performance.now();
            }
            return gaps.sort((a, b) => a - b);
        }"""
    )
    assert gaps[len(gaps) // 2] < 50, "half of the frames take more than 50 ms"


def test_a_replay_plays_to_the_end_and_closes_by_keyboard(page: Any) -> None:
    page.get_by_role("button", name="Replay episode 0", exact=True).focus()
    page.keyboard.press("Enter")
    page.wait_for_selector("#replay[open]")
    before = page.locator("#clock").inner_text()
    page.wait_for_function("before => document.getElementById('clock').textContent !== before", arg=before)
    page.select_option("#speed", "32")
    page.wait_for_function("document.getElementById('play').textContent === 'Play'")
    assert page.locator('output[data-run="oracle"]').inner_text().endswith("(reached)")
    drawn = page.locator("#replay canvas").first.evaluate(
        "c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(x => x > 0)"
    )
    assert drawn
    page.keyboard.press("Escape")
    assert page.locator("#replay[open]").count() == 0


def test_a_phone_scrolls_only_down(page: Any) -> None:
    page.set_viewport_size({"width": 390, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.set_viewport_size({"width": 1100, "height": 800})


def test_every_figure_has_a_text_and_every_control_a_name(page: Any) -> None:
    assert page.locator("figure svg[role=img]:not([aria-label])").count() == 0
    assert page.locator("#difficulty svg[role=img]").count() == 2
    unnamed = page.evaluate(
        "[...document.querySelectorAll('button, select, input')].filter("
        "e => !(e.textContent.trim() || e.ariaLabel || e.labels?.length || e.value)).length"
    )
    assert unnamed == 0


def test_paper_has_no_controls(page: Any) -> None:
    page.emulate_media(media="print")
    assert not page.locator(".filters").is_visible()
    assert page.locator("#difficulty svg").first.is_visible()
    page.emulate_media(media="screen")
