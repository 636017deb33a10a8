"""`tactile init`: the folder of a lab, and commands that work in it."""

import re
from pathlib import Path

import pytest

from rig.acquire.campaign import load_campaign
from rig.bench.bench import BenchFile, find_bench
from rig.core.packaged import BENCHES
from tactile.__main__ import main


@pytest.fixture
def lab(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Path:
    assert main(["init", str(tmp_path / "lab")]) == 0
    assert "tactile doctor --sensor tacpalm" in capsys.readouterr().out
    monkeypatch.chdir(tmp_path / "lab")
    return tmp_path / "lab"


def test_a_lab_has_a_place_for_everything(lab: Path) -> None:
    assert sorted(str(path.relative_to(lab)) for path in lab.rglob("*")) == [
        "README.md",
        "benches",
        "benches/lab",
        "calibrations",
        "campaigns",
        "campaigns/day.yaml",
        "indenters",
        "sessions",
    ]


def test_its_benches_are_mocks_until_a_file_is_put_there(lab: Path) -> None:
    assert BenchFile.read(find_bench("tacpalm", Path("benches"))).bench.mock
    example = re.search(r"```yaml\n(.*?)```", (lab / "README.md").read_text(), re.DOTALL)
    assert example is not None
    own = Path("benches/lab/tacpalm.yaml")
    own.write_text(example[1])
    assert find_bench("tacpalm", Path("benches")) == own
    file = BenchFile.read(own)
    bench, content = file.bench, file.content
    assert not bench.mock
    assert content["trajectory"] == BenchFile.read(BENCHES / "tacpalm.yaml").content["trajectory"]


def test_its_day_can_be_run(lab: Path) -> None:
    assert len(load_campaign(Path("campaigns/day.yaml"), Path("benches")).items) == 8
    assert main(["campaign", "--file", "campaigns/day.yaml", "--list"]) == 0


def test_an_empty_folder_is_taken_and_a_full_one_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["init", str(tmp_path / "empty")]) == 0
    full = tmp_path / "full"
    full.mkdir()
    for number in range(7):
        (full / f"x{number}").touch()
    assert main(["init", str(full)]) == 2
    assert "holds x0, x1, x2, x3, x4 and 2 more; allowed:" in capsys.readouterr().err
    assert len(list(full.iterdir())) == 7
    assert main(["init", str(full / "x0")]) == 2
    assert "a file; allowed" in capsys.readouterr().err
    assert main(["init", str(full / "x0" / "y")]) == 2
