"""`predict` with a model of a few weights, and its errors."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.commands import run_module
from support.force_models import TOY
from support.made_up_archives import made_up_archive

from learning.cli import evaluate, predict
from learning.data.presses import ForceRange
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.evaluation.predictions import read_predictions
from learning.evaluation.report import write_report
from learning.force.model import KIND, ForceModel
from learning.training.run import RunFolder
from recorder import MarkerArchive


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an archive, a split, and untrained models."""
    folder = tmp_path_factory.mktemp("lab")
    archive = made_up_archive(
        folder / "x.markers.zarr", targets=3, frames_per_phase=1, unlabelled=("grid",)
    )
    make_split(archive, validation=0.2, new_press=0.2).write(folder / "split.json")
    torch.manual_seed(0)
    by_flow = {"method": "priors", "translator": "flow"}
    write_model(folder / "own", sensors=["grid"])
    write_model(folder / "translated", sensors=["grid-to-dots"], **by_flow)
    write_model(folder / "all", sensors=["a", "b"])
    return folder


def write_model(folder: Path, force_range: ForceRange | None = None, **metadata: Any) -> None:
    model = ForceModel(TOY.network, TOY.input)
    if force_range:
        model.set_range(force_range)
    run = RunFolder.open(folder, KIND, TOY, "data", metadata=metadata)
    run.finish(1, {"model": model})


def run(lab: Path, model: str, out: Path, *words: str, sensor: str | None = "dots") -> int:
    places = [str(lab / model), str(lab / "x.markers.zarr"), "--split", str(lab / "split.json")]
    of_sensor = [] if sensor is None else ["--sensor", sensor]
    return run_module(predict, *places, *of_sensor, "--out", str(out), *words)


def test_predict_writes_what_a_model_says_of_whole_held_out_presses(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(lab, "own", tmp_path / "p.npz") == 0
    found = read_predictions(tmp_path / "p.npz")
    assert found.key == ("grid", "dots", "source-only", "")
    table = MarkerArchive(lab / "x.markers.zarr")["dots"].table
    assert found.true.tolist() == table["wrench"][found.rows, :3].tolist()
    assert set(found.role.tolist()) == {"new_indenter", "new_press"}
    assert set(found.indenter[found.role == "new_indenter"].tolist()) == {"cone"}
    assert len(found) == 5 * len(set(found.location.tolist()))
    assert f"{len(found)} frames, MAE [N]" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("model", "sensor", "key"),
    [
        pytest.param("translated", "dots", ("grid", "dots", "priors", "flow"), id="translated"),
        pytest.param("own", None, ("grid", "grid", "target", ""), id="usually of its target"),
        pytest.param("all", "dots", ("a+b", "dots", "source-only", ""), id="of several sensors"),
    ],
)
def test_predictions_name_source_target_labels_and_translator(
    lab: Path, tmp_path: Path, model: str, sensor: str | None, key: tuple[str, ...]
) -> None:
    assert run(lab, model, tmp_path / "p.npz", sensor=sensor) == 0
    assert read_predictions(tmp_path / "p.npz").key == key


@pytest.mark.parametrize(
    ("model", "sensor", "words", "message"),
    [
        ("translated", "grid", [], "allowed: 'dots'"),
        ("all", None, [], "--sensor: missing; known: dots, grid"),
        ("own", "dense", [], "found 'dense'; known: dots, grid"),
        ("own", "dots", ["--role", "test"], "role: found 'test'"),
    ],
)
def test_sensors_and_roles_that_are_not_there_are_refused(
    lab: Path, tmp_path: Path, model: str, sensor: str | None, words: list[str], message: str
) -> None:
    with pytest.raises(LearningError, match=message):
        run(lab, model, tmp_path / "p.npz", *words, sensor=sensor)
    assert not (tmp_path / "p.npz").exists()


def test_frames_without_labels_are_predicted_and_not_scored(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(lab, "own", tmp_path / "p.npz", sensor="grid") == 0
    found = read_predictions(tmp_path / "p.npz")
    assert np.isnan(found.true).all()
    assert np.isfinite(found.predicted).all()
    assert "no label to compare with; predicted [N] Fx" in capsys.readouterr().out
    report = write_report([found], [], tmp_path / "report")
    assert report.lines == ("grid: no label of Fx, Fy, Fz; predictions are not scored",)
    assert "Predictions without labels" in report.files[0].read_text()
    assert [file.name for file in report.files] == ["report.html", "unscored.csv"]


def test_a_model_of_fz_alone_says_so_and_is_scored_by_fz(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fz_alone = ForceRange((np.nan, np.nan, -5.0), (np.nan, np.nan, 0.0))
    write_model(tmp_path / "fz", fz_alone, sensors=["grid"])
    assert run(lab, str(tmp_path / "fz"), tmp_path / "p.npz") == 0
    found = read_predictions(tmp_path / "p.npz")
    assert np.isnan(found.predicted[:, :2]).all()
    printed = capsys.readouterr().out
    assert "MAE [N] x -  y -  z " in printed
    assert "R2 (Fz) " in printed
    assert "the model predicts Fz only" in printed
    assert "(Fz)" in write_report([found], [], tmp_path / "report").lines[0]


def test_a_model_and_an_archive_are_compared_without_a_file(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = [lab / "own", f"{lab / 'x.markers.zarr'}:dots", "--split", lab / "split.json"]
    assert run_module(evaluate, *given) == 0
    assert "frames, MAE [N] x " in capsys.readouterr().out
    assert not [*tmp_path.iterdir()]
    with pytest.raises(LearningError, match="found sensors dots, grid; allowed: one"):
        run_module(evaluate, lab / "own", lab / "x.markers.zarr")
