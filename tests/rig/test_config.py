"""Every error of a bench file states the file, the key, the value found and those allowed."""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest

from rig.bench.bench import BenchFile, find_bench
from rig.core.config import build
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES, CAMPAIGNS, packaged


@dataclass(frozen=True, slots=True)
class Round:
    KIND: ClassVar[str] = "round"
    radius: float = field(metadata={"unit": "mm"})


@dataclass(frozen=True, slots=True)
class Square:
    KIND: ClassVar[str] = "square"
    side: float = field(metadata={"unit": "mm"})


@dataclass(frozen=True, slots=True)
class Thing:
    name: str
    count: int
    speed: float = field(metadata={"unit": "mm_s"})
    shape: Round | Square
    frame: tuple[float, ...] = field(metadata={"pose": True})
    mode: Literal["a", "b"] = "a"
    on: bool = False
    box: tuple[float, float] = (0.0, 1.0)
    extra: float | None = None

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"count: {self.count}; allowed: 0 or more")


GOOD: dict[str, Any] = {
    "name": "x",
    "count": 3,
    "speed_mm_s": 5,
    "shape": {"kind": "round", "radius_mm": 2},
    "frame": {"position_mm": [1, 2, 3], "rotation_deg": [180, 0, 0]},
}


def test_units_become_si() -> None:
    thing = build(Thing, GOOD, "f.yaml")
    assert thing.speed == pytest.approx(0.005)
    assert thing.shape == Round(radius=0.002)
    assert thing.frame == pytest.approx((0.001, 0.002, 0.003, math.pi, 0, 0))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"nmae": "y"}, ["f.yaml", "unknown nmae; did you mean name?", "known"]),
        ({"name": None}, ["f.yaml.name", "nothing"]),
        ({"count": 3.0}, ["f.yaml.count", "found 3.0", "a whole number"]),
        ({"count": True}, ["f.yaml.count", "found true"]),
        ({"count": -1}, ["f.yaml", "count: -1", "0 or more"]),
        ({"speed_mm_s": "fast"}, ["f.yaml.speed_mm_s", "'fast'", "[mm/s]"]),
        ({"speed_mm_s": True}, ["f.yaml.speed_mm_s", "found true"]),
        ({"speed_mm_s": math.nan}, ["f.yaml.speed_mm_s", "nan", "finite"]),
        ({"speed_mm_s": math.inf}, ["f.yaml.speed_mm_s", "inf", "finite"]),
        ({"speed": 5}, ["unknown speed; did you mean speed_mm_s?", "speed_mm_s"]),
        ({"on": 1}, ["f.yaml.on", "found 1", "true or false"]),
        ({"mode": "c"}, ["f.yaml.mode", "'c'", "allowed: a, b"]),
        ({"box": [1]}, ["f.yaml.box", "1 values", "2"]),
        ({"box": 1}, ["f.yaml.box", "a list"]),
        ({"box": [1, "z"]}, ["f.yaml.box[1]", "'z'"]),
        ({"shape": {"kind": "oval"}}, ["f.yaml.shape.kind", "'oval'", "allowed: round, square"]),
        ({"shape": {"kind": "round", "side_mm": 1}}, ["f.yaml.shape", "side_mm", "radius_mm"]),
        ({"shape": 4}, ["f.yaml.shape", "mapping"]),
        ({"frame": [1, 2, 3]}, ["f.yaml.frame", "mapping"]),
        ({"frame": {"position_mm": [1, 2]}}, ["f.yaml.frame.position_mm", "2 values", "3"]),
    ],
)
def test_a_wrong_value_is_named(change: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        build(Thing, GOOD | change, "f.yaml")
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("key", sorted(GOOD))
def test_a_missing_key_is_named(key: str) -> None:
    content = {name: value for name, value in GOOD.items() if name != key}
    with pytest.raises(ConfigError, match=f"missing {key};"):
        build(Thing, content, "f.yaml")


ROOT = Path(__file__).parents[2]
TARGETS = {
    **dict.fromkeys(("array-i", "array-ii", "circle-i", "circle-ii", "diamond-i"), 240),
    **dict.fromkeys(("gelsight", "gelsight-mini"), 240),
    **dict.fromkeys(("digit", "gelsight-hetero", "tacpalm", "uskin"), 160),
    **dict.fromkeys(("gelsight-material", "r6", "r8", "r10", "r12", "r14", "r16", "r18"), 48),
}


@pytest.mark.parametrize("sensor", sorted(TARGETS))
def test_every_bench_in_the_repository_loads_with_the_papers_targets(sensor: str) -> None:
    bench = BenchFile.read(find_bench(sensor, BENCHES)).bench
    assert (bench.sensor, bench.mock, len(bench.trajectory)) == (sensor, True, TARGETS[sensor])
    assert bench.dry_run(bench.trajectory).broken == ()


def test_the_table_above_misses_no_bench() -> None:
    assert {path.stem for path in BENCHES.glob("*.yaml")} == {*TARGETS, "mock", "pair"}


def test_the_labs_bench_comes_before_the_mock_one(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "x.yaml").touch()
    assert find_bench("x", tmp_path) == tmp_path / "x.yaml"
    (tmp_path / "lab" / "x.yaml").touch()
    assert find_bench("x", tmp_path) == tmp_path / "lab" / "x.yaml"
    with pytest.raises(ConfigError, match=r"known in .*, x"):
        find_bench("y", tmp_path)


def test_packaged_benches_come_last_and_are_known_in_any_folder(tmp_path: Path) -> None:
    assert find_bench("tacpalm", tmp_path / "benches") == BENCHES / "tacpalm.yaml"
    (tmp_path / "tacpalm.yaml").touch()
    assert find_bench("tacpalm", tmp_path) == tmp_path / "tacpalm.yaml"


@pytest.mark.parametrize("named", ["../tacpalm.yaml", "tacpalm.yaml", "../../tacpalm.yaml"])
def test_a_labs_bench_extends_a_packaged_one_not_beside_it(tmp_path: Path, named: str) -> None:
    path = tmp_path / "benches" / "lab" / "mine.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(f"extends: {named}\ndescription: mine\n")
    file = BenchFile.read(path)
    bench, content = file.bench, file.content
    assert (bench.sensor, content["description"]) == ("tacpalm", "mine")


def test_a_file_that_is_there_is_extended_before_the_packaged_one(tmp_path: Path) -> None:
    own = tmp_path / "benches" / "tacpalm.yaml"
    own.parent.mkdir()
    own.write_text("extends: gelsight.yaml\ndescription: of the lab\n")
    path = tmp_path / "benches" / "lab" / "mine.yaml"
    path.parent.mkdir()
    path.write_text("extends: ../tacpalm.yaml\n")
    assert BenchFile.read(path).bench.description == "of the lab"


@pytest.mark.parametrize("named", ["other/tacpalm.yaml", "../nosuch.yaml", "/tacpalm.yaml"])
def test_a_wrong_folder_is_not_taken_for_a_packaged_bench(tmp_path: Path, named: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: {named}\n")
    with pytest.raises(ConfigError, match="no such file"):
        BenchFile.read(path)


@pytest.mark.parametrize(
    ("written", "folder", "meant"),
    [
        ("campaigns/day.yaml", CAMPAIGNS, CAMPAIGNS / "day.yaml"),
        ("day.yaml", CAMPAIGNS, CAMPAIGNS / "day.yaml"),
        ("benches/mock-nano17.cal", BENCHES, BENCHES / "mock-nano17.cal"),
        ("other/day.yaml", CAMPAIGNS, Path("other/day.yaml")),
        ("campaigns/night.yaml", CAMPAIGNS, Path("campaigns/night.yaml")),
    ],
)
def test_a_packaged_file_stands_in_for_one_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: str, folder: Path, meant: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert packaged(Path(written), folder) == meant
    own = tmp_path / written
    own.parent.mkdir(exist_ok=True)
    own.touch()
    assert packaged(Path(written), folder) == Path(written)


@pytest.mark.parametrize(
    ("page", "sensor", "mock"),
    [("benches/lab/README.md", "tacpalm", False), ("docs/how-to/add-a-sensor.md", "digit", True)],
)
def test_examples_of_pages_are_benches(page: str, sensor: str, mock: bool, tmp_path: Path) -> None:
    example = re.search(r"```yaml\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    assert example is not None
    path = tmp_path / "benches" / "lab" / f"{sensor}.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(example[1])
    bench = BenchFile.read(path).bench
    assert (bench.sensor, bench.mock, len(bench.trajectory)) == (sensor, mock, TARGETS[sensor])
    assert mock or bench.limits.stale_force == pytest.approx(0.05)
