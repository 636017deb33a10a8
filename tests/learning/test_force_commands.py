from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.made_up_archives import made_up_archive, write_twin

from learning.data.splits import make_split
from learning.force.loading import load_force_model
from recorder import MarkerArchive
from tactile.__main__ import main

SMALL = ["--preset", "tiny", "--set", "stages=[{epochs: 1, learning_rate: 0.001}]"]


ALL: dict[str, Any] = {"validation": 0.0, "new_press": 0.0}


@pytest.fixture(autouse=True)
def unexported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the export, which takes a second: test_force_contract has one by the command."""
    monkeypatch.setattr("learning.force.export.export_onnx", lambda *_: 0.0)


def begin(
    folder: Path, split: dict[str, Any] = ALL, **made: Any
) -> tuple[MarkerArchive, list[str]]:
    """Make an archive and a split of it; return it and the words that train a model in `run`."""
    archive = made_up_archive(folder / "x.markers.zarr", **{"frames_per_phase": 1, **made})
    make_split(archive, **split).write(folder / "split.json")
    words = ["train", "force", str(archive.path), "--split", str(folder / "split.json"), *SMALL]
    return archive, [*words, "--out", str(folder / "run"), "--set", "range_margin=0"]


def test_an_archive_becomes_a_model_and_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, words = begin(tmp_path, {"validation": 0.2, "new_press": 0.2}, targets=3)
    assert main([*words, "--sensor", "dots"]) == 0
    printed, model = capsys.readouterr().out, tmp_path / "run"
    assert "trained on 4 presses" in printed
    assert f"{model / 'model.onnx'}, {model / 'card.md'}: written" in printed
    assert main([*words, "--sensor", "dots"]) == 0
    assert "is finished" in capsys.readouterr().out
    card = (model / "card.md").read_text()
    assert "# Force model of dots" in card
    assert "4 presses with " in card
    assert "off in validation by" in card


def test_labels_by_simulation_are_learned_from_translated_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive, words = begin(tmp_path)
    words += ["--pair", "dots-to-grid"]
    one, both = ["--sensor", "dots"], ["--sensor", "dots,grid"]
    made = made_up_archive(tmp_path / "made.markers.zarr", ("dots",), frames_per_phase=1)

    def refused(*more: str, labels: object = "twin") -> str:
        assert main([*words, *more, "--labels", str(labels)]) == 2
        assert not (tmp_path / "run").exists()
        return capsys.readouterr().err

    assert "dots: found no forces of a twin; allowed: tactile sim labels" in refused(*one)
    wrench = archive["dots"].table["wrench"][:, :3]
    write_twin(archive, "dots", 0.9 * wrench)
    assert "grid: found no forces of a twin; allowed: tactile sim labels" in refused(*one)
    assert "--sensor: found dots, grid; allowed with --labels twin: one" in refused(*both)
    far = refused(*one, labels=made.path)
    assert "has no sensor 'grid'; allowed: --labels Y.markers.zarr" in far
    file = refused(*one, labels=tmp_path / "split.json")
    assert "split.json.format: found 'tactile-rig split'" in file
    # Forces of the target's twin from another archive, at the same locations.
    apart = made_up_archive(tmp_path / "apart.markers.zarr", ("grid",), frames_per_phase=1)
    write_twin(apart, "grid", 3 * wrench)
    assert main([*words, *one, "--labels", str(apart.path)]) == 0
    model = load_force_model(tmp_path / "run")
    located = archive["dots"].table["location"] >= 0
    deepest = (3 / 0.9) * wrench[located & archive["dots"].table["seen"], 2].min()
    assert float(model.low[2]) == pytest.approx(deepest, rel=1e-3)
    assert "twin of dots; twin of grid" in (tmp_path / "run" / "config.yaml").read_text()


def test_a_sensor_without_a_label_learns_the_forces_of_its_own_twin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labelled = made_up_archive(tmp_path / "y.markers.zarr", frames_per_phase=1)["dots"]
    archive, words = begin(tmp_path, unlabelled=("dots", "grid"))
    words += ["--labels", "twin", "--sensor", "dots"]
    assert main(words) == 2
    assert "dots: found no forces of a twin; allowed: tactile sim labels" in capsys.readouterr().err
    wrench = 0.7 * labelled.table["wrench"][:, :3]
    # A press without a solution has no force.
    wrench[np.flatnonzero(labelled.table["location"] == 0)] = np.nan
    write_twin(archive, "dots", wrench)
    assert main(words) == 0
    model = load_force_model(tmp_path / "run")
    assert model.axes == ("Fx", "Fy", "Fz")
    learned = (labelled.table["location"] >= 0) & labelled.table["seen"]
    assert float(model.low[2]) == pytest.approx(np.nanmin(wrench[learned, 2]), rel=1e-5)
    assert "twin of dots" in (tmp_path / "run" / "config.yaml").read_text()


def test_readings_typed_in_are_the_labels_of_a_sensor_without_a_gauge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive, words = begin(tmp_path, targets=3, frames_per_phase=2, unlabelled=("dots", "grid"))
    typed = tmp_path / "typed.csv"
    lines = [
        f"{name},{target},{-1.0 - target - place}"
        for place, name in enumerate(archive.indenters)
        for target in range(3)
    ]
    typed.write_text("\n".join(["indenter,target,fz_n", *lines]))
    one = ["--sensor", "dots"]
    assert main([*words, *one]) == 2
    assert "sensor dots: found no label of Fx, Fy or Fz" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert main([*words, "--sensor", "dots,grid", "--labels", str(typed)]) == 2
    assert "--sensor: found dots, grid; allowed with --labels " in capsys.readouterr().err

    assert main([*words, *one, "--labels", str(typed)]) == 0
    told = capsys.readouterr().out
    seen = [place for place, name in enumerate(archive.indenters) if name != "cone"]
    assert f"frames: Fx 0, Fy 0, Fz {3 * len(seen)}\n" in told
    assert "the model predicts Fz only" in told
    model = load_force_model(tmp_path / "run")
    assert model.axes == ("Fz",)
    assert float(model.low[2]) == pytest.approx(-3.0 - max(seen))
    # Other readings are other data, which a run does not continue with.
    typed.write_text(typed.read_text().replace("-1.0", "-1.5"))
    assert main([*words, *one, "--labels", str(typed)]) == 2
