"""The page of a lab in a real browser, by clicks and keys, from a phone to a large screen."""

from collections.abc import Iterator

import pytest
from support.chromium import CHROMIUM, Chromium
from support.lab_page import LabPage, make_lab, running
from support.layout import OVERFLOW

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium"),
]

# A phone, the smallest screen of a bench, a usual one, and a large one.
SIZES = ((390, 844), (1280, 800), (1920, 1080), (3840, 2160))
SHOWN = "Number(document.getElementById('view').dataset.frame)"
UNNAMED = """[...document.querySelectorAll('button, a, input, select, [role=img], [role=meter]')]
  .filter((e) => e.checkVisibility() && !(e.getAttribute('aria-label') || e.textContent.trim()
    || e.labels?.length)).map((e) => e.outerHTML.slice(0, 120))"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LabPage]:
    with running(make_lab(tmp_path_factory.mktemp("lab"))) as found:
        yield found


def text(name: str) -> str:
    return f"document.getElementById('{name}').textContent"


def key(name: str) -> str:
    event = f"new KeyboardEvent('keydown', {{key: '{name}', bubbles: true}})"
    return f"document.body.dispatchEvent({event})"


def test_a_session_is_found_replayed_and_marked(bench: LabPage) -> None:
    with Chromium() as browser:
        browser.resize(1280, 800)
        browser.open(f"{bench.base}/")
        browser.until("document.querySelectorAll('#list li').length == 4")
        browser.eval(
            "document.getElementById('q-text').value = 'ada';"
            "document.getElementById('q-text').dispatchEvent(new Event('input', {bubbles: true}))"
        )
        browser.until("document.querySelectorAll('#list li').length == 1")
        assert browser.eval(text("found")) == "1 of 4 sessions"
        browser.click("#list a")
        browser.until(f"{SHOWN} == 0")
        assert "gelsight" in browser.eval(text("s-about"))
        browser.eval(key("ArrowRight"))
        browser.until(f"{SHOWN} == 1")
        browser.eval(key("n"))
        browser.until(f"{SHOWN} > 1 && {text('r-cell')}.startsWith('Target 2')")
        browser.until("document.querySelector('#pictures img').naturalWidth == 640")
        assert "Fz" in browser.eval(text("values"))
        browser.click("#mark")
        browser.until(f"{text('marked')} == 'Marked: 2'")
        again = browser.eval("document.querySelector('#command code').textContent")
        assert again == "tactile campaign --file campaigns/again.yaml"
        browser.click("#zoom")
        browser.until("document.getElementById('slider').min > 0")
        assert "again: [2]" in (bench.folder / "campaigns" / "again.yaml").read_text()
        browser.click("nav a[href='#benches']")
        browser.until("document.getElementById('campaigns').innerText.includes('again 2')")
        browser.eval("history.back()")
        browser.until(
            f"!document.getElementById('replay').hidden && {text('marked')} == 'Marked: 2'"
        )
        browser.click("#unmark")
        browser.until(f"{text('marked')} == 'No target is marked.'")
        assert not (bench.folder / "campaigns" / "again.yaml").exists()
        assert browser.console == []


def test_colours_are_those_of_the_system_until_the_button_is_pressed(bench: LabPage) -> None:
    theme = "document.documentElement.dataset.theme"
    with Chromium() as browser:
        browser.resize(1280, 800, dark=False)
        browser.open(f"{bench.base}/")
        assert browser.eval(theme) == "light"
        browser.resize(1280, 800, dark=True)
        browser.until(f"{theme} == 'dark'")
        browser.click("#theme")
        browser.until(f"{theme} == 'light'")
        browser.open(f"{bench.base}/#benches")
        assert browser.eval(theme) == "light"


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_every_view_fits_and_everything_has_a_name(bench: LabPage, size: tuple[int, int]) -> None:
    width, height = size
    views = {
        "sessions": "document.querySelectorAll('#list li').length == 4",
        "session/day%2Fmoon.zarr": f"{SHOWN} >= 0",
        "session/u.zarr": f"{SHOWN} >= 0 && !!document.querySelector('#pictures canvas')",
        "session/live.zarr": "!document.getElementById('s-error').hidden",
        "benches": "document.querySelectorAll('#campaigns section').length == 1 && "
        "document.querySelectorAll('#benches section').length >= 3 && "
        "document.querySelectorAll('#indenters section').length >= 18",
    }
    with Chromium() as browser:
        browser.resize(width, height, dark=width < 1500)
        browser.open(f"{bench.base}/")
        for view, ready in views.items():
            browser.eval(f"location.hash = '{view}'")
            browser.until(ready)
            assert browser.eval(OVERFLOW) == [], f"{view} at {size}"
            assert browser.eval(UNNAMED) == [], view
            assert browser.eval("document.querySelector('nav').clientHeight") < 0.1 * height
            if view.startswith("session/day") and width > 1000:
                high = browser.eval("document.documentElement.scrollHeight")
                assert high <= height, f"{high} px high on a screen of {height} px"
