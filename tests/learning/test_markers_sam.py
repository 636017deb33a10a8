"""EfficientSAM through ONNX Runtime: box prompts, best masks, and checks of model files."""

import sys
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


def save(path: Path, graph: str, **constants: Any) -> Path:
    """Write an ONNX model."""
    onnx = pytest.importorskip("onnx", reason="onnx makes the small models of these tests")
    pytest.importorskip("onnxruntime", reason="onnxruntime is what is tested")
    model = onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> {graph}')
    for name, value in constants.items():
        array = np.array(value, np.int64 if name == "shape" else np.float32)
        model.graph.initializer.append(onnx.numpy_helper.from_array(array, name))
    onnx.save(model, path)
    return path


def small_encoder(path: Path) -> Path:
    """Write an encoder: its embedding is the mean of red, green and blue (1, 1, H, W)."""
    return save(
        path,
        """small (float[batch,3,height,width] batched_images)
        => (float[batch,1,height,width] image_embeddings)
        { image_embeddings = ReduceMean <axes=[1], keepdims=1> (batched_images) }""",
    )


def small_decoder(path: Path, prompts: int | str = "prompts") -> Path:
    """Write a decoder with three masks per box: empty, the dark part (best IoU), and everything.

    Labels other than 2 and 3 have no effect: a box without its corners finds nothing.
    """
    return save(
        path,
        f"""small (
            float[batch,1,480,640] image_embeddings,
            float[1,{prompts},points,2] batched_point_coords,
            float[1,{prompts},points] batched_point_labels,
            int64[2] orig_im_size
        ) => (
            float[1,{prompts},3,480,640] output_masks,
            float[1,{prompts},3] iou_predictions,
            int64[2] size
        ) {{
            corners = Reshape (batched_point_coords, shape)
            left, top, right, bottom = Split <axis=2> (corners)
            a = GreaterOrEqual (x, left)
            b = GreaterOrEqual (y, top)
            c = LessOrEqual (x, right)
            d = LessOrEqual (y, bottom)
            ab = And (a, b)
            cd = And (c, d)
            inside = And (ab, cd)
            off = Sub (batched_point_labels, labels)
            wrong = Abs (off)
            fault = ReduceMax <keepdims=0> (wrong)
            dark = Sub (half, image_embeddings)
            sure = Sub (dark, fault)
            best = Where (inside, sure, least)
            nothing = Mul (best, zero)
            empty = Add (nothing, least)
            all = Sub (nothing, least)
            output_masks = Concat <axis=2> (empty, best, all)
            of_prompts = ReduceMean <axes=[2], keepdims=1> (off)
            zeros = Mul (of_prompts, zero)
            iou_predictions = Add (zeros, guess)
            size = Identity (orig_im_size)
        }}""",
        shape=[1, -1, 4, 1, 1],
        x=np.arange(WIDTH),
        y=np.arange(HEIGHT)[:, None],
        labels=[2, 3],
        half=0.5,
        least=-1,
        zero=0,
        guess=[0.2, 0.9, 0.4],
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
def test_boxes_at_rough_centres_become_whole_markers(prompts: int | str, tmp_path: Path) -> None:
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
        """small (
            float[batch,256,64,64] image_embeddings, float[1,prompts,1,2] batched_point_coords,
            float[1,prompts,1] batched_point_labels, int64[2] orig_im_size
        ) => (float[1,prompts,1,2] output_masks)
        { output_masks = Identity (batched_point_coords) }""",
    )
    with pytest.raises(LearningError, match=r"points\.onnx: takes 1 points a prompt; allowed: 2"):
        EfficientSam(encoder, points)
    with pytest.raises(LearningError, match=r"none\.onnx: no such file"):
        EfficientSam(tmp_path / "none.onnx", decoder)


def test_without_onnx_runtime_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "any.onnx").write_bytes(b"anything")
    with pytest.raises(LearningError, match="needs onnxruntime: pip install"):
        EfficientSam(tmp_path / "any.onnx", tmp_path / "any.onnx")
