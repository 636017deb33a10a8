"""The page in a real browser, with a real mock collection."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.chromium import CHROMIUM, Chromium
from support.collecting import page_of
from support.layout import OVERFLOW
from support.live_quality import GELSIGHT, PLACES, picture, recording

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from rig.acquire.collector import CollectRequest
from rig.acquire.control import Control
from rig.core.packaged import BENCHES
from rig.monitor.access import AccessPolicy
from rig.monitor.collection import CollectionJob, CollectionPage
from rig.monitor.lab import Folders

pytestmark = [
    pytest.mark.serial,
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium"),
]

# Output path for a new picture of docs/how-to/record-at-the-bench.md.
PICTURE = os.environ.get("WATCH_PICTURE")
QUALITY_PICTURE = os.environ.get("QUALITY_PICTURE")
# Colour of the text of each judgement, and of its ground.
COLOURS = """[...document.querySelectorAll('#quality .state')]
  .map((e) => getComputedStyle(e).color + getComputedStyle(e).backgroundColor)"""
STATUS = "document.body.dataset.status"
SHOWN = "Number(document.getElementById('image').dataset.shown || 0)"
# A phone upright and on its side, a tablet, the smallest screen of a bench, and a large one.
SIZES = ((390, 844), (844, 390), (768, 1024), (1280, 800), (1920, 1080), (3840, 2160))
INK = """(() => {
  const canvas = document.getElementById('%s'), pen = canvas.getContext('2d');
  const data = pen.getImageData(0, 0, canvas.width, canvas.height).data, colours = new Set();
  for (let k = 0; k < data.length; k += 4)
    if (data[k + 3]) colours.add(data[k] << 16 | data[k + 1] << 8 | data[k + 2]);
  return colours.size;
})()"""
SUM = """(() => {
  const canvas = document.getElementById('image'), pen = canvas.getContext('2d');
  const data = pen.getImageData(0, 0, canvas.width, canvas.height).data;
  return data.reduce((sum, value, k) => (sum * 31 + value) % 2147483647, 7);
})()"""


def bench(folder: Path) -> Path:
    """Write a fast bench with a soft force limit that the deeper presses reach."""
    limits = "{force_rating_n: [12.0, 12.0, 1.1]}"
    return quick_bench(
        folder,
        "tacpalm",
        limits=limits,
        more="trajectory: {depth_step_mm: 2.25}\nskin: {modulus_kpa: [0.1, 0.1]}",
    )


@contextmanager
def watched(folder: Path, *arguments: str) -> Iterator[tuple[CollectionRun, Chromium]]:
    """Yield a collection with a page, and a browser that shows it."""
    with Chromium() as browser:
        collection = CollectionRun.collect(
            folder / "s.zarr", "--bench", str(bench(folder)), "--watch", "0", *arguments
        )
        try:
            browser.resize(1440, 900)
            browser.open(page_of(collection))
            yield collection, browser
        finally:
            collection.kill_all()


def text(name: str) -> str:
    return f"document.getElementById('{name}').textContent"


def count(name: str) -> str:
    return f"Number(document.getElementById('n-{name}').textContent)"


def fits(browser: Chromium) -> None:
    """Nothing overflows at any size, and a wide screen shows all at once."""
    for width, height in SIZES:
        browser.resize(width, height, dark=width > 800)
        assert browser.eval(OVERFLOW) == [], f"at {width} x {height}"
        header = browser.eval("document.querySelector('header').clientHeight")
        assert header < 0.25 * height, f"a header of {header} px at {width} x {height}"
        browser.eval("document.getElementById('reason').hidden = true")
        if width > 1100:
            high = browser.eval("document.documentElement.scrollHeight")
            assert high <= height, f"{high} px high on a screen of {height} px"


def test_a_collection_can_be_watched_paused_and_resumed(tmp_path: Path) -> None:
    with watched(tmp_path, "--targets", "11") as (collection, browser):
        browser.until(f"{STATUS} == 'collecting' && {SHOWN} > 2")
        first = browser.eval(SUM)
        browser.until(f"{SHOWN} > 8")
        assert browser.eval(INK % "image") > 100
        browser.until(f"({SUM}) != {first}")
        browser.until(f"({INK % 'traces'}) > 20")
        browser.until(f"{count('done')} >= 2")
        assert browser.eval("document.querySelectorAll('#map path.done').length") >= 2
        assert browser.eval("document.querySelectorAll('#map path.current').length") == 1
        rates = browser.eval("document.getElementById('streams').innerText")
        assert "1000 Hz" in rates
        assert "camera" in rates

        browser.click("#pause")
        browser.until(f"{STATUS} == 'paused'")
        assert browser.eval("document.getElementById('pause').textContent") == "Resume"
        held = browser.eval(count("done"))
        browser.eval("new Promise((wait) => setTimeout(wait, 1500))")
        assert browser.eval(count("done")) == held
        browser.click("#pause")
        browser.until(f"{STATUS} == 'collecting'")

        judged = "[...document.querySelectorAll('#quality li')].map((row) => row.innerText)"
        browser.until(f"{judged}.every((row) => row.startsWith('good'))")
        assert len(browser.eval(judged)) == 4
        browser.until(f"{count('limited')} >= 1")
        browser.until(f"{STATUS} == 'complete'")
        assert "11 of 11 targets" in browser.eval("document.getElementById('reason').textContent")
        assert browser.eval("document.getElementById('abort').disabled") is True
        assert collection.wait() == 0, collection.text
        # A large page takes the cores of the bench, so it is looked at after the collection.
        fits(browser)
        complaints = [line for line in browser.console if "ERR_CONNECTION_REFUSED" not in line]
        assert complaints == []


def test_a_fault_of_the_recording_is_seen_by_words_and_colour(tmp_path: Path) -> None:
    with recording(GELSIGHT, tmp_path) as made, Chromium() as browser:
        request = CollectRequest(made.path, GELSIGHT.trajectory, 48)
        job = CollectionJob.of(GELSIGHT, tmp_path, request)
        with CollectionPage(AccessPolicy(port=0), Folders(tmp_path, BENCHES), job) as page:
            page.begin(Control(), dict, made.path, 0)
            browser.resize(1280, 800)
            browser.open(page.urls[0])
            for _ in range(2):
                made.second()
            browser.until("document.querySelectorAll('#quality .good').length == 4")
            calm = browser.eval(COLOURS)
            for _ in range(2):
                made.second(
                    image=lambda load: picture(missing=2),
                    force=lambda ms, load: (1.5 * (ms == 300), 0.0, 0.0),
                )
            browser.until("document.querySelectorAll('#quality .good').length == 2")
            browser.until(f"{text('quality-all')} == '1 at fault, 1 to look at'")
            words = browser.eval("document.getElementById('quality').innerText")
            assert f"{len(PLACES) - 2} of {len(PLACES)} seen at rest" in words
            assert "x spike" in words
            assert browser.eval(COLOURS)[0] != calm[0]
            assert browser.eval(COLOURS)[1] == calm[1]
            fits(browser)
            if QUALITY_PICTURE is not None:
                browser.resize(1280, 800)
                browser.screenshot(Path(QUALITY_PICTURE))


def test_abort_asks_first_and_then_ends_the_collection(tmp_path: Path) -> None:
    with watched(tmp_path) as (collection, browser):
        browser.until(f"{count('done')} >= 1")
        if PICTURE is not None:
            browser.until(f"{count('limited')} >= 4")
            browser.screenshot(Path(PICTURE))
        browser.click("#abort")
        browser.until("document.getElementById('confirm').open")
        browser.click("#go-on")
        browser.until("!document.getElementById('confirm').open")
        assert browser.eval(STATUS) == "collecting"
        browser.click("#abort")
        browser.click("#abort-now")
        browser.until(f"{STATUS} == 'stopped'")
        assert "aborted by the page" in browser.eval("document.getElementById('reason').innerText")
        assert collection.wait() == 130, collection.text


def test_a_lost_connection_shows_at_once_and_the_next_collection_by_itself(tmp_path: Path) -> None:
    with watched(tmp_path, "--targets", "1") as (collection, browser):
        browser.until(f"{STATUS} == 'collecting'")
        collection.kill_all()
        browser.until("!document.getElementById('lost').hidden")
        port = browser.eval("location.port")
        folder = tmp_path / "next"
        folder.mkdir()
        following = CollectionRun.collect(
            folder / "s.zarr", "--bench", str(bench(folder)), "--watch", port, "--targets", "1"
        )
        try:
            browser.until(f"{STATUS} == 'complete'")
            assert browser.eval("document.getElementById('lost').hidden") is True
            assert following.wait() == 0, following.text
        finally:
            following.kill_all()
