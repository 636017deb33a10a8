from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from support.force_models import TOY, noise_presses

from benchmarks.recording.latency import costs, section
from benchmarks.report import Page
from learning.data.presses import ForceRange
from learning.errors import LearningError
from learning.force.export import export_onnx
from learning.force.model import ForceModel
from learning.force.stream import open_exported


@pytest.fixture(scope="module")
def model() -> ForceModel:
    torch.manual_seed(0)
    model = ForceModel(TOY.network, TOY.input).eval()
    model.set_range(ForceRange((-4.0, -4.0, -18.0), (4.0, 4.0, 1.0)))
    return model


@pytest.fixture(scope="module")
def exported(model: ForceModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exported") / "model.onnx"
    assert export_onnx(model, path) < 1e-4
    return path


@pytest.mark.slow
def test_a_reset_forgets_what_was_seen(exported: Path) -> None:
    stream = open_exported(exported)
    presses = noise_presses(1)
    stream.reset(presses.references[0].numpy())
    first = stream.step(presses.images[0].numpy())
    assert not np.array_equal(first, stream.step(presses.images[0].numpy()))
    stream.reset()
    assert np.array_equal(stream.step(presses.images[0].numpy()), first)


def test_frames_that_do_not_fit_a_stream_are_refused(exported: Path) -> None:
    stream = open_exported(exported)
    image = np.zeros((256, 256), np.uint8)
    with pytest.raises(LearningError, match="reference: missing"):
        stream.step(image)
    with pytest.raises(LearningError, match=r"reference: found \(64, 64\) uint8"):
        stream.reset(image[:64, :64])
    stream.reset(image)
    with pytest.raises(LearningError, match=r"frame: found \(256, 256\) float64"):
        stream.step(image.astype(np.float64))


def test_files_that_are_no_exported_model_are_refused(tmp_path: Path, exported: Path) -> None:
    with pytest.raises(LearningError, match=r"model\.onnx: no such file"):
        open_exported(tmp_path)
    (tmp_path / "broken.onnx").write_bytes(exported.read_bytes()[:200])
    with pytest.raises(LearningError, match="cannot be loaded as an ONNX model"):
        open_exported(tmp_path / "broken.onnx")
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        [helper.make_node("Identity", ["x"], ["y"])],
        "other",
        [value("x", TensorProto.FLOAT, [1])],
        [value("y", TensorProto.FLOAT, [1])],
    )
    other = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(other, tmp_path / "other.onnx")
    with pytest.raises(LearningError, match="found inputs x; allowed: frame, state, reference"):
        open_exported(tmp_path / "other.onnx")
    with pytest.raises(LearningError, match="runtime: found 'tensorrt'; allowed: onnx, openvino"):
        open_exported(exported, runtime="tensorrt")


def test_an_export_overwrites_nothing(model: ForceModel, exported: Path) -> None:
    before = exported.read_bytes()
    with pytest.raises(LearningError, match="exists; allowed: a new file"):
        export_onnx(model, exported)
    assert exported.read_bytes() == before


FEW = (("torch", "fp32"), ("torch", "bf16"), ("onnxruntime", "fp32"), ("onnxruntime", "int8"))


@pytest.mark.slow
def test_costs_are_of_every_way_to_run_a_model(
    model: ForceModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The calibration's progress bar would keep a thread for the life of the process.
    monkeypatch.setattr("tqdm.tqdm.monitor_interval", 0)
    rows = costs("toy", model, tmp_path, FEW, 3)
    assert [(row["runtime"], row["precision"]) for row in rows] == [*FEW]
    assert rows[0]["difference_n"] == 0.0
    assert all(0 < row["difference_n"] < 1 for row in rows[1:3])
    assert "runtime: found 'onnx-int8'" in rows[3]["remark"]
    assert section(rows, Page(tmp_path / "page.md")).count("| toy |") == 4
    assert (tmp_path / "images" / "page-latency.png").read_bytes().startswith(b"\x89PNG")


def test_a_runtime_that_is_missing_is_a_line_with_its_reason(
    model: ForceModel, exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "openvino", None)
    with pytest.raises(LearningError, match="openvino: not installed"):
        open_exported(exported, runtime="openvino")
