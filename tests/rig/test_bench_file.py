"""A bench file: built once for a collection, and again with the addresses of emulators."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from rig.bench import bench as bench_module
from rig.bench.bench import Bench, BenchFile
from rig.cli import recording
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from rig.mock.bench import MockBench
from tactile.__main__ import main


@pytest.mark.parametrize("command", ["collect", "home", "force-depth", "calibrate-latency"])
@pytest.mark.parametrize(("more", "count"), [("", 2), ("mock: false\nworld: null\n", 1)])
def test_a_command_that_records_builds_its_bench_once(
    command: str, more: str, count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[str] = []
    build = bench_module.bench_from

    def counted(content: dict[str, Any], where: str) -> Bench:
        built.append(where)
        return build(content, where)

    class Idle:
        """A collector that records nothing."""

        def __init__(self, bench: Bench, *_: object) -> None:
            assert (bench.arm.host == "loopback") is (count == 1)

        def run(self, *_: object) -> int:
            return 3

    monkeypatch.setattr(bench_module, "bench_from", counted)
    monkeypatch.setattr(recording, "Collector", Idle)
    monkeypatch.setattr(recording, "confirm", lambda _: None)
    monkeypatch.setattr(recording, "logged_to", lambda _: nullcontext())
    monkeypatch.setattr(MockBench, "_start", lambda _: None)
    monkeypatch.chdir(tmp_path)
    Path("bench.yaml").write_text(f"extends: {BENCHES / 'gelsight.yaml'}\n{more}")
    assert main([command, "--bench", "bench.yaml", "--indenter", "prism"]) == 3
    # A mock bench is built again with the addresses of its emulators.
    assert built == ["bench.yaml"] * count


def test_addresses_are_filled_in_everywhere_and_the_file_stays_as_it_was(tmp_path: Path) -> None:
    file = BenchFile.read(BENCHES / "gelsight.yaml")
    placed = file.at("127.1.2.3", tmp_path)
    assert "loopback" in str(file.content)
    assert "loopback" not in str(placed.content)
    assert placed.bench.arm.host == "127.1.2.3"
    assert placed.path == file.path


def test_an_indenter_is_in_content_and_bench_and_an_empty_name_is_that_of_the_file() -> None:
    file = BenchFile.read(BENCHES / "gelsight.yaml")
    prism = file.with_indenter("prism")
    assert (prism.content["indenter"], prism.bench.indenter) == ("prism", "prism")
    assert file.with_indenter("").bench.indenter == file.bench.indenter
    with pytest.raises(ConfigError, match="did you mean prism"):
        file.with_indenter("prsm")
