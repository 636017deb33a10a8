"""Live prediction of three-axis force from camera pictures or taxel scans.

    predictor = open_live("models/force", preset_name="bench-tacpalm")
    for picture in camera:
        found = predictor.step(picture)  # None while the reference is being taken

Each frame is processed like the training data: markers by a preset of `learning.markers`, then the
image or marker field that the network takes (`input_of`), then a network step that keeps its state.
The first frames must show the sensor without contact. Training sequences are short and begin
without contact, so the state is reset while nothing touches the sensor (`ContactDetector`).
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.data.images import shrink
from learning.errors import LearningError
from learning.force.folder import model_name
from learning.force.intervals import (
    Intervals,
    edge_length,
    read_intervals,
    shapes_of,
    shapes_of_shading,
)
from learning.force.made_for import Conditions, differences, made_for, other_pattern
from learning.force.slip import SlipWatch
from learning.force.stream import ForceStream, open_exported
from learning.markers.displacement import MAP_SIDE, FieldReader
from learning.markers.frames import one_thread, taxel_masks
from learning.markers.pattern import with_reference
from learning.markers.segment import (
    CameraPreset,
    Preset,
    Segmenter,
    ShadingPreset,
    TaxelPreset,
    built_preset,
    cells_of,
    change_of,
    names,
    preset,
    preset_of_sensor,
    shading_of,
)
from learning.training.checkpoint import CONFIG, read_config
from recorder.archive import SHADING, SHADING_ZERO
from recorder.markers import HEIGHT, WIDTH, count_markers, pack

# Network inputs from a stream of masks: images or marker fields.

# A mask (480, 640) bool, or shading (3, 128, 128) uint8.
Mask = NDArray[Any]


@dataclass(frozen=True, slots=True)
class NetworkInput:
    """Converts the masks of a stream to inputs of a network."""

    of: Callable[[Mask], NDArray[Any]]
    """Returns the input for the next mask."""
    restart: Callable[[], None] = lambda: None
    """Forgets earlier frames; the next one shows no contact."""
    reference: NDArray[np.uint8] | None = None
    """Image of the sensor without contact, for a network that takes images."""
    moved: Callable[[], NDArray[np.float64]] | None = None
    """Returns the displacement of the markers (m, 2) [px] in the last mask, if they are tracked."""


def input_of(network: ForceStream, reference: Mask) -> NetworkInput:
    """Return the converter from masks to a network's inputs, by the mask without contact."""
    shape = network.inputs.frame[1:]
    if (shape == SHADING.shape) != (reference.shape == SHADING.shape):
        raise LearningError(
            f"model: takes frames {shape}; allowed: a preset of shading for a model of shading, "
            "and one of markers for another"
        )
    if shape == SHADING.shape:
        return NetworkInput(lambda mask: mask)
    if network.inputs.is_image:
        return NetworkInput(_image, reference=_image(reference))
    if shape != (3, MAP_SIDE, MAP_SIDE):
        raise LearningError(
            f"model: takes frames {shape}; allowed: images, or marker fields (3, {MAP_SIDE}, "
            f"{MAP_SIDE})"
        )
    fields = TrackedFields(reference)
    return NetworkInput(fields.of, fields.restart, moved=lambda: fields.moved)


def _image(mask: Mask) -> NDArray[np.uint8]:
    """Return the image (256, 256) of a mask (480, 640), as in the training data."""
    (image,) = shrink(pack(mask)[None])
    return np.asarray(image, np.uint8)


class TrackedFields(FieldReader):
    """Marker fields (3, 32, 32), with markers tracked from frame to frame."""

    def of(self, mask: Mask) -> NDArray[np.float32]:
        """Return displacement [px] and growth (3, 32, 32) of the next mask (480, 640)."""
        match = self._matcher.step(mask)
        self.moved = match.moved
        """Displacement of the markers (m, 2) [px] in the last mask."""
        values = np.concatenate([match.moved, match.growth[:, None]], axis=1)
        field = (self._map_operator @ values).T.reshape(3, MAP_SIDE, MAP_SIDE)
        return np.ascontiguousarray(field, np.float32)

    def restart(self) -> None:
        """Expect the next mask to look like the reference."""
        self._matcher.restart()


# Contact detection from the motion of marker edges, or from the change of colours.
#
# The number of pixels in which a mask differs from the reference, divided by the length of the
# markers' edges, is the mean motion of those edges [px]. Its largest value in the frames without
# contact is the noise. Contact begins above twice the noise plus a margin. It ends after several
# consecutive frames below, so that a press that briefly looks like no contact keeps its history.


# Factor on the largest motion among the frames without contact.
TIMES_NOISE = 2.0
# Margin added to it, and the largest motion accepted in frames without contact: as mean motion of
# the markers' edges [px of 640 x 480], and as mean change of colours [grey levels].
LEAST_PX, NOISE_PX = 0.02, 0.5
LEAST_LEVELS, NOISE_LEVELS = 0.3, 3.0
# Number of consecutive frames below the threshold that end contact.
STILL_FRAMES = 5


class ContactDetector:
    """Detects contact from the masks of one sensor."""

    reference: NDArray[Any]
    """Majority of the masks without contact (480, 640), or shading without change."""

    def __init__(self, no_contact: NDArray[Any]) -> None:
        """Compute the mask without contact and its noise.

        They are of masks (n, 480, 640), or shading (n, 3, 128, 128) uint8, one or more.
        """
        self._is_shading = no_contact.dtype == np.uint8
        least, most = LEAST_PX, NOISE_PX
        what, unit = "markers move", "px"
        if self._is_shading:
            least, most = LEAST_LEVELS, NOISE_LEVELS
            what, unit = "colours change", "grey levels"
            self.reference = np.full_like(no_contact[0], SHADING_ZERO)
        else:
            self.reference = np.asarray(2 * no_contact.sum(axis=0) > len(no_contact), np.bool_)
        self._edge = 0 if self._is_shading else edge_length(self.reference)
        if not (self._edge or self._is_shading):
            raise LearningError("frames without contact: found no markers; allowed: another preset")
        noise = max(self.moved(mask) for mask in no_contact)
        if noise > most:
            raise LearningError(
                f"frames without contact: their {what} by {noise:.2f} {unit}; allowed: "
                f"{most} {unit}; was the sensor touched while its reference was taken?"
            )
        self.threshold_px = TIMES_NOISE * noise + least
        """Mean motion of edges above which there is contact [px]."""
        self._still = STILL_FRAMES
        self.motion_px = 0.0
        """Mean motion of the markers' edges in the last frame [px]."""

    def moved(self, mask: Mask) -> float:
        """Return the mean distance of the markers' edges from their undeformed positions [px].

        Of shading it is the mean change of colours [grey levels].
        """
        if self._is_shading:
            return change_of(mask)
        return float(np.count_nonzero(mask != self.reference)) / self._edge

    def step(self, mask: Mask) -> bool:
        """Return True if the sensor is touched in the next frame (480, 640)."""
        self.motion_px = self.moved(mask)
        self._still = 0 if self.motion_px > self.threshold_px else self._still + 1
        return self._still < STILL_FRAMES


Frame = NDArray[Any]

# Number of frames without contact for the reference.
START_FRAMES = 10
# Name in place of a preset's for frames that are masks.
MASKS = "masks"
_TAXELS = (16, 3)
# Least noise of markers [px], and of taxels [counts], above which slip is seen.
LEAST_NOISE_PX, LEAST_NOISE_COUNTS = 0.01, 1.0


Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class LiveForce:
    """Prediction for one frame."""

    force: Triple
    """Fx, Fy, Fz on the sensor [N]; pressing is negative Fz; NaN on axes unknown to the model."""
    contact: bool
    """True if the sensor is touched; if not, the force is the network's output without
    contact."""
    motion_px: float
    """Mean motion of the markers' edges [px of 640 x 480]; of shading, mean change of colours
    [grey levels]."""
    interval: tuple[Triple, Triple] | None = None
    """Lower and upper ends of the 90 % intervals of Fx, Fy, Fz [N]; None: the model has none."""
    outside: bool = False
    """True if the frame is outside of what the model learned from."""
    before: Triple | None = None
    """Fx, Fy, Fz that the other model predicts [N]; None: there is no other."""
    slip: str = ""
    """`gross`, `incipient` or `none` (`learning.force.slip`); empty: slip is not watched."""


class LivePredictor:
    """Predicts the force of each frame of a live stream."""

    def __init__(
        self,
        network: ForceStream,
        chosen: Preset | None,
        *,
        start_frames: int = START_FRAMES,
        intervals: Intervals | None = None,
        before: ForceStream | None = None,
        seen: Callable[[int], None] = lambda markers: None,
    ) -> None:
        """Create a predictor, which takes its reference from `start_frames` without contact.

        The preset finds markers in pictures or draws them from taxels; without one, frames are
        masks (480, 640). `before` is the stream of another model, whose forces are shown beside.
        `seen` is called with the number of markers that are seen without contact.
        """
        if start_frames < 1:
            raise LearningError(f"start_frames: found {start_frames}; allowed: 1 or more")
        self._networks = [network] if before is None else [network, before]
        self.intervals = intervals
        """Intervals of the model; None if it has none."""
        self._preset, self._start_frames = chosen, start_frames
        self._seen = seen
        self._first: list[Frame] = []
        self._contact: ContactDetector
        self._mask_of: MaskOf
        self._inputs: list[NetworkInput] = []
        self._slips: SlipWatch | None = None
        self._rest: NDArray[Any] | None = None

    @property
    def has_before(self) -> bool:
        """True if forces of another model are shown beside."""
        return len(self._networks) > 1

    @property
    def reference(self) -> NDArray[Any] | None:
        """The mask without contact (480, 640), or shading without change; None until known."""
        return self._contact.reference if self._inputs else None

    def begin(self, frames: NDArray[Any]) -> None:
        """Take the reference from frames without contact, and forget all earlier frames.

        Frames are pictures (n, h, w, 3) uint8, RGB, or counts of taxels (n, 16, 3).
        """
        if not len(frames):
            raise LearningError("frames without contact: found none; allowed: one or more")
        masks, self._mask_of = _masks(self._preset, frames)
        self._contact = ContactDetector(masks)
        self._inputs = [input_of(each, self._contact.reference) for each in self._networks]
        for network, network_input in zip(self._networks, self._inputs, strict=True):
            network.reset(network_input.reference)
        self._slips = self._watch_slip(frames, masks)
        self._first.clear()
        if masks.dtype == np.bool_:
            self._seen(count_markers(self._contact.reference))

    def _watch_slip(self, frames: NDArray[Any], masks: NDArray[Any]) -> SlipWatch | None:
        """Return a watch of the taxels or markers, by their noise in frames without contact.

        None if the network takes frames in which markers are not tracked.
        """
        first = self._inputs[0]
        taxels = isinstance(self._preset, TaxelPreset)
        self._rest = np.asarray(frames, np.float64).mean(axis=0) if taxels else None
        if not taxels and first.moved is None:
            return None
        pairs = zip(frames, masks, strict=True)
        fields = np.array([(first.of(mask), self._field(frame))[1] for frame, mask in pairs])
        first.restart()
        noise = float(np.std(fields - fields.mean(axis=0)))
        return SlipWatch(max(noise, LEAST_NOISE_COUNTS if taxels else LEAST_NOISE_PX))

    def _field(self, frame: Frame) -> NDArray[Any]:
        """Return counts of taxels less those without contact, or how the markers moved at last."""
        moved = self._inputs[0].moved
        return frame - self._rest if self._rest is not None or moved is None else moved()

    def step(self, frame: Frame, t_ns: int | None = None) -> LiveForce | None:
        """Return the force of the next picture (h, w, 3) uint8, RGB, or counts of taxels (16, 3).

        None while the reference is being taken. Slip is watched if the frame's time is given [ns].
        """
        if not self._inputs:
            self._first.append(np.array(frame))
            if len(self._first) >= self._start_frames:
                self.begin(np.stack(self._first))
            return None
        reading = self._predicted(frame)
        if t_ns is None or self._slips is None:
            return reading
        slip = self._slips.update(t_ns, self._field(frame))
        seen = "none" if slip is None else "gross" if slip.gross else "incipient"
        return replace(reading, slip=seen)

    def press(self, frames: NDArray[Any], times: int = 1) -> list[LiveForce]:
        """Return the forces of the frames of one press, in order, each shown a number of times.

        The press begins without contact; the state begins with it, and is kept to its end.
        """
        for network, network_input in zip(self._networks, self._inputs, strict=True):
            network.reset()
            network_input.restart()
        return [self._predicted(frame, times) for frame in frames]

    def _predicted(self, frame: Frame, times: int = 0) -> LiveForce:
        """Predict the next frame of a press, shown some times, or with 0 of an endless stream."""
        mask = self._mask_of(frame)
        contact = self._contact.step(mask)
        forces: list[Triple] = []
        for network, network_input in zip(self._networks, self._inputs, strict=True):
            if not (contact or times):
                network.reset()
                network_input.restart()
            for _ in range(times or 1):
                force = network.step(network_input.of(mask))
            forces.append(_triple(force))
        interval, outside = None, False
        if self.intervals is not None:
            predicted = np.array(forces[:1])
            low, high = self.intervals.of(predicted)
            interval = _triple(low[0]), _triple(high[0])
            of_markers = mask.dtype == np.bool_
            shape = (
                shapes_of(mask[None], self._contact.reference)
                if of_markers
                else shapes_of_shading(mask[None])
            )
            outside = bool(self.intervals.is_outside(predicted, shape)[0])
        before = forces[1] if self.has_before else None
        return LiveForce(forces[0], contact, self._contact.motion_px, interval, outside, before)


def _triple(values: NDArray[np.float64]) -> Triple:
    x, y, z = values.tolist()
    return x, y, z


def open_live(
    model: str | os.PathLike[str],
    *,
    before: str | os.PathLike[str] | None = None,
    runtime: str = "auto",
    sensor: str | None = None,
    preset_name: str | None = None,
    met: Conditions | None = None,
    warn: Callable[[str], None] = lambda text: None,
    network: ForceStream | None = None,
) -> LivePredictor:
    """Return the predictor of a finished force model, named as for `load_force_model`.

    `before` is another model, whose forces are shown beside. The runtime is that of an exported
    model, `torch`, or `auto`: ONNX Runtime if the model was exported, else torch. The preset of a
    model of markers is that of the sensor, by default the only one that it was made for, or
    `preset_name`: a name, a YAML file, or `MASKS` for frames that are masks. `warn` is
    called with each difference between the sensor that it meets, `met`, and those that it was made
    for. `network` runs the model, if it is open.

    Raises:
        LearningError: The model or preset does not exist, the sensor has no preset, or its signal
            is another one than the model was made for.
    """
    one_thread()
    folder = Path(model_name(os.fspath(model)))
    made = made_for(folder)
    if sensor is None and len({one.sensor for one in made}) == 1:
        sensor = made[0].sensor
    if met is not None:
        for text in differences(folder.name, made, met):
            warn(text)

    def seen(markers: int) -> None:
        if text := other_pattern(folder.name, made, sensor or "", markers):
            warn(text)

    network = network or _stream(folder, runtime)
    chosen = None
    if preset_name != MASKS:
        chosen = preset(preset_name) if preset_name else _preset_for(network, sensor, folder)
    return LivePredictor(
        network,
        chosen,
        intervals=read_intervals(folder),
        before=None if before is None else _stream(before, runtime),
        seen=seen,
    )


def _preset_for(network: ForceStream, sensor: str | None, model: Path) -> Preset:
    """Return the preset for a model and a sensor.

    It is the one by which the model's own markers of this sensor were found, else that of the
    sensor's name, else the only one by which all markers of the model were found.
    """
    if network.inputs.frame[1:] == SHADING.shape:
        return preset(ShadingPreset.KIND)
    written = (model / CONFIG).is_file()
    presets: dict[str, Any] = read_config(model).metadata.get("presets", {}) if written else {}
    name = None
    if sensor is not None:
        name = presets.get(sensor) or preset_of_sensor(sensor)
    if name is None and presets:
        first, *others = presets.values()
        name = None if any(other != first for other in others) else first
    if name is None:
        reason = f"sensor {sensor!r} has none, and the model " + (
            f"knows several: {', '.join(sorted(presets))}" if presets else "knows none"
        )
        raise LearningError(
            f"preset: missing: {reason}; allowed: the one that the sensor's markers were found "
            f"with: {', '.join(names())}, or a .yaml file"
        )
    key_path = f"{model / CONFIG}.metadata.presets"
    return preset(name) if isinstance(name, str) else built_preset(name, key_path)


def _stream(name: str | os.PathLike[str], runtime: str) -> ForceStream:
    model = model_name(os.fspath(name))
    if runtime == "auto":
        runtime = "onnx" if (Path(model) / "model.onnx").is_file() else "torch"
    if runtime != "torch":
        return open_exported(model, runtime=runtime)
    from learning.force.export import torch_stream
    from learning.force.loading import load_force_model

    return torch_stream(load_force_model(model))


# Masks of a stream, by presets: a function of its first frames, without contact (n, ...), returns
# their masks and a function that makes the mask of a later frame.

MaskOf = Callable[[Frame], Mask]


def _masks(chosen: Preset | None, frames: NDArray[Any]) -> tuple[NDArray[Any], MaskOf]:
    if chosen is None:
        return frames, lambda frame: np.reshape(frame, (HEIGHT, WIDTH)) != 0
    if isinstance(chosen, ShadingPreset):
        return _shading(chosen, frames)
    if isinstance(chosen, CameraPreset):
        return _pictures(chosen, frames)
    rest = _counts(frames[0], frames).mean(axis=0)
    masks = taxel_masks(frames, rest, chosen)
    return masks, lambda frame: taxel_masks(_counts(frame, frame), rest, chosen)


def _pictures(chosen: CameraPreset, frames: NDArray[Any]) -> tuple[NDArray[np.bool_], MaskOf]:
    """Make masks (480, 640) of camera pictures (h, w, 3)."""
    segmenter = Segmenter(chosen)
    views = [segmenter.view(frame) for frame in frames]
    finder = with_reference(segmenter, views[-1])
    masks = np.stack([segmenter.mask_of_view(view) for view in views])
    return masks, lambda frame: finder.mask_of_view(segmenter.view(frame))


def _shading(chosen: ShadingPreset, frames: NDArray[Any]) -> tuple[NDArray[np.uint8], MaskOf]:
    """Make shading (3, 128, 128) of camera pictures, relative to mean colours without contact."""
    cells = np.stack([cells_of(frame, chosen) for frame in frames])
    no_contact = np.asarray(cells.mean(axis=0), np.float32)
    return shading_of(cells, no_contact), lambda frame: shading_of(
        cells_of(frame, chosen), no_contact
    )


def _counts(frame: Frame, values: NDArray[Any]) -> NDArray[np.float64]:
    counts = np.asarray(values, np.float64)
    if frame.shape != _TAXELS or not np.isfinite(counts).all():
        raise LearningError(f"taxels: found {frame.shape}; allowed: finite counts {_TAXELS}")
    return counts
