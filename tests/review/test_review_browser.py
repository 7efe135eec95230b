"""The page opens in a browser without a network, complains about nothing, shows every picture and prints."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rerun")
pytest.importorskip("jinja2")
pytest.importorskip("playwright", reason="playwright drives the browser: pip install playwright")

from playwright.sync_api import sync_playwright

from tests.review.drives import made_page

NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((path for name in NAMES if (path := shutil.which(name))), None)


@pytest.fixture(scope="module")
def page() -> Iterator[tuple[Any, list[str]]]:
    """The page, opened in an offline browser, and everything that the browser said or asked for."""
    out = made_page()
    with sync_playwright() as p:
        if BROWSER is None and not Path(p.chromium.executable_path).exists():
            pytest.skip("no Chromium: apt-get install chromium, or playwright install chromium")
        browser = p.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        context = browser.new_context(offline=True, viewport={"width": 1100, "height": 900})
        opened, noted = context.new_page(), []
        opened.on("console", lambda m: noted.append(f"console: {m.text}"))
        opened.on("pageerror", lambda e: noted.append(f"error: {e}"))
        opened.on("request", lambda r: noted.append(f"request: {r.url[:80]}"))
        opened.goto(out.as_uri())
        opened.wait_for_load_state("load")
        yield opened, noted
        browser.close()


def test_it_complains_about_nothing_and_asks_for_nothing_but_itself(page) -> None:
    opened, noted = page
    beside = [n for n in noted if not n.startswith("request: data:") and n != f"request: {opened.url[:80]}"]
    assert beside == []


def test_every_picture_is_there(page) -> None:
    opened, _ = page
    sizes = opened.evaluate("[...document.images].map(i => i.complete ? i.naturalWidth : 0)")
    assert len(sizes) >= 5 and min(sizes) > 300


def test_nothing_is_wider_than_the_window_even_a_narrow_one(page) -> None:
    opened, _ = page
    opened.set_viewport_size({"width": 720, "height": 900})
    assert opened.evaluate("document.documentElement.scrollWidth") <= 720
    opened.set_viewport_size({"width": 1100, "height": 900})


def test_each_slow_down_of_the_table_leads_to_its_picture(page) -> None:
    opened, _ = page
    links = opened.evaluate("[...document.querySelectorAll('a[href^=\"#\"]')].map(a => a.getAttribute('href'))")
    assert links
    for link in links:
        assert opened.locator(f"{link} img").count() == 1


def test_it_prints_on_a_few_sheets_with_no_picture_cut_in_two(page) -> None:
    opened, _ = page
    assert opened.pdf(format="A4", print_background=True).startswith(b"%PDF")
    opened.emulate_media(media="print")
    cuts = opened.evaluate("[...document.querySelectorAll('.card')].map(c => getComputedStyle(c).breakInside)")
    assert cuts and set(cuts) == {"avoid"}
    assert opened.evaluate("getComputedStyle(document.querySelector('details')).display") == "none"
    opened.emulate_media(media="screen")
