"""EfficientSAM through ONNX Runtime: box prompts, best masks, and checks of model files."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.learning_sessions import altered, record

from learning.errors import LearningError
from learning.markers import Segmenter, preset
from learning.markers.build import archive_sessions
from learning.markers.efficient_sam import EfficientSam
from recorder import MarkerArchive, Session, SessionError
from tests.support.few import few

HEIGHT, WIDTH = 480, 640


def save(path: Path, nodes: Any, inputs: Any, outputs: Any, constants: Any = ()) -> Path:
    """Write an ONNX model; shapes contain numbers, or names for free axes."""
    onnx = pytest.importorskip("onnx", reason="onnx makes the small models of these tests")
    pytest.importorskip("onnxruntime", reason="onnxruntime is what is tested")
    kinds = {"f": onnx.TensorProto.FLOAT, "i": onnx.TensorProto.INT64}
    info = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node(op, i, o, **options) for op, i, o, options in nodes],
        "small",
        [info(name, kinds[kind], shape) for name, kind, shape in inputs],
        [info(name, kinds[kind], shape) for name, kind, shape in outputs],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants],
    )
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), path)
    return path


def small_encoder(path: Path, name: str = "batched_images") -> Path:
    """Write an encoder: its embedding is the mean of red, green and blue (1, 1, H, W)."""
    return save(
        path,
        [("ReduceMean", [name], ["image_embeddings"], {"axes": [1], "keepdims": 1})],
        [(name, "f", ["batch", 3, "height", "width"])],
        [("image_embeddings", "f", ["batch", 1, "height", "width"])],
    )


def small_decoder(path: Path, prompts: int | str = "prompts", points: int | str = "points") -> Path:
    """Write a decoder with three masks per box: empty, the dark part (best IoU), and everything."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    constants = [
        ("x", x[None, None]),
        ("y", y[None, None]),
        ("half", np.array(0.5, np.float32)),
        ("one", np.array(1.0, np.float32)),
        ("least", np.array(-1.0, np.float32)),
        ("offers", np.array([-1.0, 1.0, 1.0], np.float32).reshape(1, 1, 3, 1, 1)),
        ("all", np.array([0.0, 0.0, 1.0], np.float32).reshape(1, 1, 3, 1, 1)),
        ("guess", np.array([0.2, 0.9, 0.4], np.float32).reshape(1, 1, 3)),
        ("axis2", np.array([2], np.int64)),
        ("sides", np.array([2, 3], np.int64)),
        ("second", np.array([2.0, 3.0], np.float32)),
    ]
    for corner in (0, 1):
        for axis in (0, 1):
            starts, ends = np.array([corner, axis]), np.array([corner + 1, axis + 1])
            constants += [(f"from{corner}{axis}", starts), (f"to{corner}{axis}", ends)]
    nodes: list[Any] = []
    for corner in (0, 1):
        for axis in (0, 1):
            cut = f"{corner}{axis}"
            given = ["batched_point_coords", f"from{cut}", f"to{cut}", "sides"]
            # (1, Q, 1, 1) against (1, 1, H, W).
            nodes.append(("Slice", given, [f"c{cut}"], {}))
    nodes += [
        ("GreaterOrEqual", ["x", "c00"], ["a"], {}),
        ("GreaterOrEqual", ["y", "c01"], ["b"], {}),
        ("LessOrEqual", ["x", "c10"], ["c"], {}),
        ("LessOrEqual", ["y", "c11"], ["d"], {}),
        ("And", ["a", "b"], ["ab"], {}),
        ("And", ["c", "d"], ["cd"], {}),
        ("And", ["ab", "cd"], ["inside"], {}),
        ("Sub", ["half", "image_embeddings"], ["dark"], {}),
        # Labels other than 2 and 3 have no effect: a box without its corners finds nothing.
        ("Sub", ["batched_point_labels", "second"], ["off"], {}),
        ("Abs", ["off"], ["wrong"], {}),
        ("ReduceMax", ["wrong"], ["fault"], {"keepdims": 0}),
        ("Sub", ["dark", "fault"], ["sure"], {}),
        ("Where", ["inside", "sure", "least"], ["best"], {}),
        ("Unsqueeze", ["best", "axis2"], ["best5"], {}),
        ("Abs", ["best5"], ["large"], {}),
        ("Sub", ["offers", "all"], ["use"], {}),
        ("Mul", ["best5", "use"], ["signed"], {}),
        ("Sub", ["use", "one"], ["never"], {}),
        ("Add", ["signed", "never"], ["lowered"], {}),
        ("Add", ["lowered", "all"], ["output_masks"], {}),
        ("ReduceMean", ["batched_point_labels"], ["rows"], {"axes": [2], "keepdims": 1}),
        ("Mul", ["rows", "least"], ["minus"], {}),
        ("Add", ["rows", "minus"], ["zeros"], {}),
        ("Add", ["zeros", "guess"], ["iou_predictions"], {}),
        ("Identity", ["orig_im_size"], ["size"], {}),
    ]
    return save(
        path,
        nodes,
        [
            ("image_embeddings", "f", ["batch", 1, HEIGHT, WIDTH]),
            ("batched_point_coords", "f", [1, prompts, points, 2]),
            ("batched_point_labels", "f", [1, prompts, points]),
            ("orig_im_size", "i", [2]),
        ],
        [
            ("output_masks", "f", [1, prompts, 3, HEIGHT, WIDTH]),
            ("iou_predictions", "f", [1, prompts, 3]),
            ("size", "i", [2]),
        ],
        constants,
    )


def scene() -> tuple[Any, Any, Any]:
    """Return a picture with 8 dark discs, their mask, and a rough mask that is too small."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    apart = [
        np.hypot(x - 100 - 120 * column, y - 100 - 200 * row)
        for row in range(2)
        for column in range(4)
    ]
    distance = np.min(apart, axis=0)
    picture = np.where(distance[..., None] <= 9, 40, 200).astype(np.uint8).repeat(3, axis=2)
    return picture, distance <= 9, distance <= 4


@pytest.mark.parametrize("prompts", few(["prompts", 1, 3], 1))
def test_boxes_around_rough_centres_come_back_as_whole_markers(
    prompts: int | str, tmp_path: Path
) -> None:
    encoder, decoder = tmp_path / "encoder.onnx", tmp_path / "decoder.onnx"
    sam = EfficientSam(small_encoder(encoder), small_decoder(decoder, prompts))
    picture, whole, rough = scene()
    np.testing.assert_array_equal(sam.refined(picture, rough, 15), whole)
    # A box smaller than a marker cuts it.
    assert 0 < sam.refined(picture, rough, 5).sum() < whole.sum()
    assert not sam.refined(picture, np.zeros_like(rough), 15).any()
    assert len(set(sam.identity.values())) == 2


@pytest.mark.slow
def test_an_archive_is_refined_and_keeps_to_its_weights(tmp_path: Path) -> None:
    encoder, decoder = tmp_path / "encoder.onnx", tmp_path / "decoder.onnx"
    sam = EfficientSam(small_encoder(encoder), small_decoder(decoder))
    whole = record(tmp_path / "whole.zarr")
    # Every frame shows the same picture, which is processed once.
    session = altered(whole, tmp_path / "s.zarr", {"frames/image": np.full(32, 20)})
    out = tmp_path / "a.markers.zarr"
    archive_sessions([session], out, sam=sam)
    sensor = MarkerArchive(out)["gelsight"]
    (picture,) = Session(session).streams["camera"].images([20])
    # Dark areas by the small model, in boxes of 31 px: they contain markers of 21 px.
    dark = picture.astype(np.float32).mean(axis=2) / 255 <= 0.5
    rough = Segmenter(preset("bench-gelsight")).mask(picture)  # type: ignore[arg-type]
    (mask,) = sensor.masks([7])
    assert not (mask & ~dark).any()
    assert mask[rough & dark].mean() > 0.99
    assert (mask != rough).any()
    assert sensor.attrs["efficient_sam"] == sam.identity
    with pytest.raises(SessionError, match="is not the archive that was planned"):
        archive_sessions([session], out)


def test_files_that_are_no_such_model_are_refused_by_name(tmp_path: Path) -> None:
    encoder = small_encoder(tmp_path / "encoder.onnx")
    decoder = small_decoder(tmp_path / "decoder.onnx")
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(encoder.read_bytes()[:40])
    with pytest.raises(LearningError, match=r"damaged\.onnx: is no model that ONNX Runtime"):
        EfficientSam(damaged, decoder)
    with pytest.raises(LearningError, match=r"encoder\.onnx: takes batched_images; expected image"):
        EfficientSam(encoder, encoder)
    points = save(
        tmp_path / "points.onnx",
        [("Identity", ["batched_point_coords"], ["output_masks"], {})],
        [
            ("image_embeddings", "f", ["batch", 256, 64, 64]),
            ("batched_point_coords", "f", [1, "prompts", 1, 2]),
            ("batched_point_labels", "f", [1, "prompts", 1]),
            ("orig_im_size", "i", [2]),
        ],
        [("output_masks", "f", [1, "prompts", 1, 2])],
    )
    with pytest.raises(LearningError, match=r"points\.onnx: takes 1 points a prompt; allowed: 2"):
        EfficientSam(encoder, points)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(LearningError, match=r"none\.onnx: no such file"):
        EfficientSam(tmp_path / "none.onnx", tmp_path / "none.onnx")


def test_without_onnx_runtime_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.partition(".")[0] == "onnxruntime":
            raise ModuleNotFoundError(f"No module named {name!r}", name="onnxruntime")
        return whole(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    (tmp_path / "any.onnx").write_bytes(b"anything")
    with pytest.raises(LearningError, match="needs onnxruntime: pip install"):
        EfficientSam(tmp_path / "any.onnx", tmp_path / "any.onnx")
