"""The preview draws every bench's plan, prints its numbers, and rejects plans beyond a limit."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from rig.__main__ import main
from rig.core.packaged import BENCHES


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ("gelsight", ("240 targets, 960 recorded moves", "depth 1.200 mm")),
        ("gelsight-material", ("48 targets",)),
        ("gelsight-hetero", ("160 targets", "depth 1.000 mm")),
        ("uskin", ("160 targets", "at 60 Hz")),
        ("tacpalm", ("160 targets", "x -8.00 to +8.00 mm", "depth 4.957 mm")),
    ],
)
def test_every_plan_is_drawn_and_described(
    sensor: str, words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "plan.png"
    arguments = ["preview", "--sensor", sensor, "--benches", str(BENCHES), "--out", str(picture)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    for word in (*words, "soft limit", "paper: 20 to 60", str(picture)):
        assert word in printed
    with Image.open(picture) as image:
        colours = image.convert("RGB").getcolors(1 << 20) or []
    assert len(colours) > 20


def test_a_plan_that_breaks_a_limit_is_drawn_and_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = tmp_path / "deep.yaml"
    bench.write_text(f"extends: {BENCHES / 'tacpalm.yaml'}\nlimits: {{depth_max_mm: 4.0}}\n")
    picture = tmp_path / "plan.png"
    assert main(["preview", "--bench", str(bench), "--out", str(picture)]) == 2
    assert "BREAKS A LIMIT: depth: 4.957 mm; allowed: 4.000 mm" in capsys.readouterr().out
    assert picture.exists()


@pytest.mark.parametrize(
    ("plan", "reported"),
    [
        ("trajectory: {depth_step_mm: 0.005}", "trajectory: found 36000 targets at 900 depths"),
        (
            "force_depth: {kind: force_depth, depth_max_mm: 4.5, repeats: 1000000}",
            "force_depth: found 1000000 targets",
        ),
    ],
)
def test_a_plan_of_too_many_targets_is_refused_before_it_is_walked(
    plan: str, reported: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = tmp_path / "deep.yaml"
    bench.write_text(f"extends: {BENCHES / 'tacpalm.yaml'}\n{plan}\n")
    assert main(["preview", "--bench", str(bench), "--out", str(tmp_path / "plan.png")]) == 2
    assert f"{bench}: {reported}; allowed: up to 20000" in capsys.readouterr().err
    assert not (tmp_path / "plan.png").exists()


def test_a_force_depth_press_is_drawn_too(tmp_path: Path) -> None:
    bench = tmp_path / "prism.yaml"
    bench.write_text(
        f"extends: {BENCHES / 'gelsight.yaml'}\n"
        "trajectory: {kind: force_depth, depth_max_mm: 1.2, repeats: 3}\n"
    )
    picture = tmp_path / "plan.png"
    assert main(["preview", "--bench", str(bench), "--out", str(picture)]) == 0
    assert picture.exists()
