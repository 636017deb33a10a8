"""Every bench's plan is drawn and described; one beyond a limit is a fault of the bench."""

from pathlib import Path

import pytest
from PIL import Image

from rig.acquire.doctor import plan
from rig.acquire.preview import summary
from rig.bench.bench import BenchFile
from rig.core.errors import ConfigError
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
def test_plans_are_drawn_and_described(sensor: str, words: tuple[str, ...], tmp_path: Path) -> None:
    bench = BenchFile.read(BENCHES / f"{sensor}.yaml").bench
    walked = bench.dry_run(bench.trajectory)
    described = "\n".join(summary(bench, walked))
    for word in (*words, "soft limit", "paper: 20 to 60"):
        assert word in described
    picture = tmp_path / "sessions" / f"{sensor}-plan.png"
    finding = plan(bench, tmp_path / "sessions")
    assert finding.state == "well"
    assert finding.text.startswith(f"{walked.targets} targets, ")
    assert finding.text.endswith(f"drawn in {picture}")
    with Image.open(picture) as image:
        colours = image.convert("RGB").getcolors(1 << 20) or []
    assert len(colours) > 20


def test_a_plan_that_breaks_a_limit_is_drawn_and_a_fault(tmp_path: Path) -> None:
    file = tmp_path / "deep.yaml"
    file.write_text(f"extends: {BENCHES / 'tacpalm.yaml'}\nlimits: {{depth_max_mm: 4.0}}\n")
    finding = plan(BenchFile.read(file).bench, tmp_path)
    assert finding.state == "FAULT"
    assert "breaks depth: 4.957 mm; allowed: 4.000 mm" in finding.text
    assert (tmp_path / "tacpalm-plan.png").exists()


def test_a_folder_that_cannot_be_written_is_said_and_the_plan_is_checked_all_the_same(
    tmp_path: Path,
) -> None:
    (tmp_path / "file").touch()
    finding = plan(BenchFile.read(BENCHES / "tacpalm.yaml").bench, tmp_path / "file")
    assert finding.state == "well"
    assert "not drawn: " in finding.text


@pytest.mark.parametrize(
    ("trajectory", "reported"),
    [
        ("trajectory: {depth_step_mm: 0.005}", "trajectory: found 36000 targets at 900 depths"),
        (
            "force_depth: {kind: force_depth, depth_max_mm: 4.5, repeats: 1000000}",
            "force_depth: found 1000000 targets",
        ),
    ],
)
def test_a_plan_of_too_many_targets_is_refused_before_it_is_walked(
    trajectory: str, reported: str, tmp_path: Path
) -> None:
    file = tmp_path / "deep.yaml"
    file.write_text(f"extends: {BENCHES / 'tacpalm.yaml'}\n{trajectory}\n")
    with pytest.raises(ConfigError, match=f"{file}: {reported}; allowed: up to 20000"):
        BenchFile.read(file)


def test_a_force_depth_press_is_drawn_too(tmp_path: Path) -> None:
    file = tmp_path / "prism.yaml"
    file.write_text(
        f"extends: {BENCHES / 'gelsight.yaml'}\n"
        "trajectory: {kind: force_depth, depth_max_mm: 1.2, repeats: 3}\n"
    )
    assert plan(BenchFile.read(file).bench, tmp_path).state == "well"
    assert (tmp_path / "gelsight-plan.png").exists()
