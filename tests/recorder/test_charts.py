"""Charts: one style whatever the user's settings, and the same bytes for the same chart."""

import io
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from PIL import Image
from support.commands import python

from recorder.charts import BLUE, FORCES, chart


def drawn(file: Path | io.BytesIO) -> None:
    with chart(file, 4, 3) as figure:
        axes = figure.subplots()
        axes.plot([0, 1, 2], [0.0, 1.0, 4.0], label="fem")
        axes.set(xlabel="depth [mm]", ylabel="force [N]")
        axes.legend()


def test_a_chart_has_the_style_and_the_size_that_were_asked_for() -> None:
    png = io.BytesIO()
    drawn(png)
    with Image.open(png) as picture:
        assert picture.size == (600, 450)
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20) or ()}
    assert tuple(bytes.fromhex(BLUE[1:])) in colours
    assert (255, 255, 255) in colours


def test_pages_and_charts_share_the_colours_of_forces() -> None:
    style = (Path(__file__).parents[2] / "rig/monitor/static/page.css").read_text()
    names = (f"--f{axis}: {colour};" for axis, colour in zip("xyz", FORCES, strict=True))
    assert " ".join(names) in style


def test_settings_of_the_user_neither_change_a_chart_nor_are_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours, again = io.BytesIO(), io.BytesIO()
    drawn(ours)
    monkeypatch.setitem(matplotlib.rcParams, "axes.facecolor", "red")
    before = dict(matplotlib.rcParams)
    drawn(again)
    assert again.getvalue() == ours.getvalue()
    assert dict(matplotlib.rcParams) == before


def test_the_suffix_is_the_format_and_equal_charts_are_equal_bytes(tmp_path: Path) -> None:
    for name in ("a/one.svg", "b/two.svg"):
        drawn(tmp_path / name)
    one = (tmp_path / "a" / "one.svg").read_bytes()
    assert one.startswith(b"<?xml")
    assert b"force [N]" in one
    assert one == (tmp_path / "b" / "two.svg").read_bytes()


def test_a_chart_that_fails_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no data"), chart(tmp_path / "x.png", 4, 3):
        raise ValueError("no data")
    assert not list(tmp_path.iterdir())


def test_colours_differ_in_brightness_or_are_told_apart_without_red_and_green() -> None:
    with chart(io.BytesIO(), 1, 1):
        cycle = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"]
    rgb = np.array([list(bytes.fromhex(colour.lstrip("#"))) for colour in cycle], float)
    # Red and green merged into one: all that is left to a reader who confuses them.
    seen = np.stack([rgb[:, :2] @ (0.35, 0.65), rgb[:, 2]], axis=1)
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=2)[np.triu_indices(len(cycle), 1)]
    assert apart.min() > 25


@pytest.mark.slow
def test_matplotlib_is_imported_with_the_first_chart_and_without_its_global_state() -> None:
    code = """
import io, sys
import recorder.charts
print("matplotlib" in sys.modules)
with recorder.charts.chart(io.BytesIO(), 1, 1):
    pass
print("matplotlib" in sys.modules, "matplotlib.pyplot" in sys.modules)
"""
    assert python("-c", code).stdout.split() == ["False", "True", "False"]
