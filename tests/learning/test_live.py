"""Frames become forces one by one, starting without contact; memory ends with contact."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.dot_camera import MarkerCamera, PressedSurface
from support.marker_truth import VIEWS

from learning.data.images import shrink
from learning.errors import LearningError
from learning.force.live import (
    STILL_FRAMES,
    ContactDetector,
    LiveForce,
    LivePredictor,
    _preset_for,
    open_live,
)
from learning.force.made_for import KEY, Conditions, differences, made_for, other_pattern
from learning.force.stream import FRAME, REFERENCE, STATE, ForceStream, StepInputs
from learning.markers import Segmenter, preset
from learning.markers.displacement import FieldReader
from learning.markers.frames import taxel_masks
from learning.markers.segment import FOLDER as PRESETS
from learning.markers.segment import (
    CameraPreset,
    ShadingPreset,
    TaxelPreset,
    cells_of,
    kept_preset,
    shading_of,
)
from learning.training.checkpoint import Config
from recorder.archive import SHADING, SHADING_ZERO
from recorder.markers import pack

NO_CONTACT = np.full((16, 3), 30_000.0)
SHAPE = (1, 256, 256)


class Stub:
    """A network that counts its steps in its state and returns the image it was given."""

    def __init__(self) -> None:
        self.frames: list[np.ndarray[Any, Any]] = []
        self.references: list[np.ndarray[Any, Any]] = []

    def __call__(self, given: Any) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        self.frames.append(given[FRAME][0])
        self.references += list(given.get(REFERENCE, []))
        after = given[STATE] + 1
        steps = float(after[0, 0, 0, 0])
        return np.array([[steps, 0.0, -float(given[FRAME].mean())]], np.float32), after

    def stream(self) -> ForceStream:
        return ForceStream(self, StepInputs(SHAPE, True, (1, 1, 1, 1), True))


def touched(taxel: int = 5, z: float = 4000.0) -> np.ndarray[Any, Any]:
    counts = NO_CONTACT.copy()
    counts[taxel, 2] += z
    return counts


def shown(predictor: LivePredictor, frame: Any) -> LiveForce:
    found = predictor.step(frame)
    assert found is not None
    return found


def uskin() -> tuple[LivePredictor, Stub]:
    chosen = preset("uskin")
    assert isinstance(chosen, TaxelPreset)
    stub = Stub()
    return LivePredictor(stub.stream(), chosen, start_frames=3), stub


def test_the_first_frames_are_the_reference_and_say_no_force() -> None:
    predictor, stub = uskin()
    assert [predictor.step(NO_CONTACT + offset) for offset in (-1, 0, 1)] == [None, None, None]
    found = shown(predictor, NO_CONTACT)
    assert not found.contact
    assert found.motion_px == 0.0
    assert predictor.reference is not None
    image = shrink(pack(taxel_masks(NO_CONTACT[None], NO_CONTACT, TaxelPreset("still"))))[0]
    assert np.array_equal(stub.references[-1], image)
    assert np.array_equal(stub.frames[-1], image)


def test_memory_is_kept_while_touched_and_cleared_when_contact_has_ended() -> None:
    predictor, _ = uskin()
    predictor.begin(np.stack([NO_CONTACT] * 3))
    frames = [NO_CONTACT, NO_CONTACT, touched(), touched(), NO_CONTACT, touched()]
    frames += [NO_CONTACT] * (STILL_FRAMES + 2)
    found = [shown(predictor, frame) for frame in frames]
    steps = [one.force[0] for one in found]
    # Each frame without contact starts again; a short loss of contact does not clear the memory.
    assert steps[:6] == [1, 1, 2, 3, 4, 5]
    assert steps[6:] == [6, 7, 8, 9, 1, 1, 1]
    assert [one.contact for one in found] == [step > 1 for step in steps]


def test_a_picture_goes_the_way_of_the_training_data() -> None:
    chosen = preset("bench-gelsight")
    assert isinstance(chosen, CameraPreset)
    camera = MarkerCamera(VIEWS["bench-gelsight"], grey_noise=1.0)
    no_contact = [
        camera.image(PressedSurface((0.0, 0.0), 0.0, 0.0, 4e-3, (0.0, 0.0))) for _ in range(4)
    ]
    pressed = camera.image(PressedSurface((0.0, 0.0), 0.5e-3, 2e-3, 4e-3, (0.3e-3, 0.0)))
    stub = Stub()
    predictor = LivePredictor(stub.stream(), chosen, start_frames=3)
    assert [predictor.step(picture) for picture in no_contact[:3]] == [None] * 3
    assert not shown(predictor, no_contact[3]).contact
    found = shown(predictor, pressed)
    assert found.contact
    assert found.motion_px > 0.5
    image = shrink(pack(Segmenter(chosen).mask(pressed))[None])[0]
    assert np.array_equal(stub.frames[-1], image)


def test_a_light_touch_is_contact_and_noise_is_not() -> None:
    random = np.random.default_rng(0)
    chosen = TaxelPreset("noise")
    scans = NO_CONTACT + random.normal(scale=2.1, size=(60, 16, 3))
    masks = taxel_masks(scans, NO_CONTACT, chosen)
    contact = ContactDetector(masks[:10])
    assert not any(contact.step(mask) for mask in masks[10:])
    assert contact.step(taxel_masks(touched(z=400.0), NO_CONTACT, chosen))


def test_a_touched_sensor_at_the_beginning_and_frames_of_another_sensor_are_refused() -> None:
    predictor, _ = uskin()
    predictor.step(NO_CONTACT)
    predictor.step(NO_CONTACT)
    with pytest.raises(LearningError, match="was the sensor touched"):
        predictor.step(NO_CONTACT + 4000.0)
    predictor.begin(np.stack([NO_CONTACT] * 3))
    for frame in (np.zeros((4, 3)), np.full((16, 3), np.nan)):
        with pytest.raises(LearningError, match="taxels: found"):
            predictor.step(frame)
    predictor = LivePredictor(Stub().stream(), preset("bench-gelsight"), start_frames=1)
    with pytest.raises(LearningError, match="found no markers"):
        predictor.step(np.zeros((480, 640, 3), np.uint8))


def test_a_model_of_marker_fields_is_shown_those_of_the_training_data() -> None:
    chosen = preset("uskin")
    assert isinstance(chosen, TaxelPreset)
    stub = Stub()
    network = ForceStream(stub, StepInputs((1, 3, 32, 32), False, (1, 1, 1, 1), False))
    predictor = LivePredictor(network, chosen)
    predictor.begin(np.stack([NO_CONTACT] * 3))
    steps = np.linspace(0.0, 1.0, 4)
    scans = np.array(
        [NO_CONTACT + (touched() - NO_CONTACT + 900.0 * (NO_CONTACT > 0)) * step for step in steps]
    )
    for scan in scans:
        predictor.step(scan)
    due = FieldReader(
        ContactDetector(taxel_masks(NO_CONTACT[None], NO_CONTACT, chosen)).reference
    ).maps(taxel_masks(scans, NO_CONTACT, chosen), ordered=True)
    assert np.allclose(np.array(stub.frames), due, atol=1e-5)
    assert np.abs(due[-1]).max() > 1.0


def test_a_model_of_something_else_or_none_is_refused(tmp_path: Any) -> None:
    odd = ForceStream(Stub(), StepInputs((1, 2, 8, 8), False, (1, 1, 1, 1), False))
    with pytest.raises(LearningError, match=r"takes frames \(2, 8, 8\)"):
        LivePredictor(odd, preset("uskin")).begin(np.stack([NO_CONTACT] * 3))
    for runtime in ("onnx", "openvino", "openvino-bf16"):
        with pytest.raises(LearningError, match=r"model\.onnx: no such file"):
            open_live(tmp_path, sensor="uskin", runtime=runtime)
    with pytest.raises(LearningError, match="runtime: found 'paper'"):
        open_live(tmp_path, sensor="uskin", runtime="paper")


def test_the_preset_is_that_of_the_model_s_markers_or_of_the_sensor(tmp_path: Path) -> None:
    shading, markers = (
        ForceStream(Stub(), StepInputs((1, *shape), True, (1, 1, 1, 1), False))
        for shape in (SHADING.shape, SHAPE[1:])
    )
    nothing = tmp_path / "nothing"
    assert _preset_for(shading, "nobody", nothing) == preset("shading")
    assert _preset_for(markers, "uskin", nothing) == preset("uskin")
    with pytest.raises(LearningError, match=r"'nobody' has none, and the model knows none; allow"):
        _preset_for(markers, "nobody", nothing)

    # A preset of the user's own is kept as the content of its file, which may be gone.
    own = tmp_path / "own.yaml"
    own.write_text((PRESETS / "gelslim.yaml").read_text())
    kept = {"gelslim": kept_preset(str(own)), "uskin": kept_preset("uskin-from-top")}
    assert kept_preset("gone.yaml") is None
    Config("force", {}, "data", "1", {"presets": kept}).write(tmp_path)
    own.unlink()
    assert _preset_for(markers, "gelslim", tmp_path) == preset("gelslim")
    assert _preset_for(markers, "uskin", tmp_path) == preset("uskin-from-top")
    with pytest.raises(LearningError, match="the model knows several: gelslim, uskin; allowed: "):
        _preset_for(markers, "nobody", tmp_path)
    Config("force", {}, "data", "1", {"presets": {"a-to-b": "gelslim"}}).write(tmp_path)
    assert _preset_for(markers, "nobody", tmp_path) == preset("gelslim")


@pytest.mark.parametrize(
    ("here", "words"),
    [
        (Conditions("gelsight", "camera", depth=1.05e-3), []),
        (Conditions("gelsight", "camera", depth=1.3e-3), ["this bench presses to 1.30 mm"]),
        (Conditions("tacpalm", "camera", "pins"), ["(63 markers, to 1.00 mm), not for tacpalm (p"]),
    ],
)
def test_a_model_meets_what_it_was_not_made_for(
    here: Conditions, words: list[str], tmp_path: Path
) -> None:
    name = "uskin-to-gelsight"
    kept = {"sensors": [name], KEY: {name: {"markers": 63, "depth_mm": 1.0}}}
    Config("force", {}, "data", "1", kept).write(tmp_path)
    made = made_for(tmp_path)
    found = list(differences("m", made, here))
    assert [word in text for word, text in zip(words, found, strict=True)] == [True] * len(words)
    with pytest.raises(LearningError, match=r"camera of gelsight .*; found the taxels of uskin"):
        list(differences("m", made, Conditions("uskin", "taxels")))
    assert not other_pattern("m", made, "gelsight", 61)
    assert "127 markers: another pattern" in other_pattern("m", made, "gelsight", 127)


def test_shading_is_seen_live_as_in_archives_and_its_change_is_contact() -> None:
    chosen = ShadingPreset("bare gel")
    random = np.random.default_rng(0)
    still = [random.integers(99, 102, (60, 80, 3)).astype(np.uint8) for _ in range(4)]
    stub = Stub()
    stream = ForceStream(stub, StepInputs((1, *SHADING.shape), True, (1, 1, 1, 1), False))
    predictor = LivePredictor(stream, chosen, start_frames=3)
    assert [predictor.step(picture) for picture in still[:3]] == [None, None, None]
    assert not shown(predictor, still[3]).contact
    pressed = still[3].copy()
    pressed[20:40, 30:50, 0] += 60
    assert shown(predictor, pressed).contact
    no_contact = np.mean([cells_of(picture, chosen) for picture in still[:3]], axis=0)
    expected = shading_of(cells_of(pressed, chosen), no_contact.astype(np.float32))
    assert np.array_equal(stub.frames[-1], expected)
    assert int(stub.frames[-1][0].max()) == pytest.approx(SHADING_ZERO + 60, abs=3)
    of_markers = ForceStream(stub, StepInputs(SHAPE, True, (1, 1, 1, 1), True))
    with pytest.raises(LearningError, match="a preset of shading for a model of shading"):
        LivePredictor(of_markers, chosen).begin(np.stack(still))
