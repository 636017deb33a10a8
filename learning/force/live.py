"""Force while it happens: a picture or a scan of taxels in, three axes of force out.

    predictor = open_live("models/force", preset_name="bench-tacpalm")
    for picture in camera:
        found = predictor.step(picture)  # None while the untouched sensor is looked at

Each frame goes the way of the training data: markers by a preset of `learning.markers`, the image
or the marker field that the network takes (`shown_to`), the network step by step with its memory
carried along. The first frames must show the untouched sensor. Training sequences begin untouched
and are short, so the memory is cleared for as long as nothing touches the sensor (`ContactRule`).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from learning.data.images import shrink
from learning.errors import LearningError
from learning.force.stream import ForceStream, open_exported
from learning.markers.displacement import MAP_SIDE, FieldReader
from learning.markers.frames import one_thread, taxel_masks
from learning.markers.segment import CameraPreset, Preset, Segmenter, preset, preset_of_sensor
from recorder.markers import pack

# What a network is shown of a mask, frame after frame: its image, or its marker field.

Mask = NDArray[np.bool_]


class Shown(Protocol):
    """Makes of masks what a network takes."""

    @property
    def reference(self) -> NDArray[np.uint8] | None:
        """The image of the untouched sensor, for a network that takes images."""

    def of(self, mask: Mask) -> NDArray[Any]:
        """Return what is shown of the next mask (480, 640)."""

    def restart(self) -> None:
        """Forget the frames before: the next is untouched."""


def shown_to(network: ForceStream, reference: Mask) -> Shown:
    """Return what makes of masks what a network takes.

    Args:
        network: The force model.
        reference: The untouched mask (480, 640).

    Raises:
        LearningError: A network of another input, or a reference without markers.
    """
    shape = network.inputs.frame[1:]
    if network.inputs.is_image:
        return Images(reference)
    if shape != (3, MAP_SIDE, MAP_SIDE):
        raise LearningError(
            f"model: takes frames {shape}; allowed: images, or marker fields (3, {MAP_SIDE}, "
            f"{MAP_SIDE})"
        )
    return Fields(reference)


class Images:
    """Images of 256 x 256, as training data have them."""

    def __init__(self, reference: Mask) -> None:
        """Take the untouched mask (480, 640)."""
        self.reference: NDArray[np.uint8] | None = self.of(reference)

    def of(self, mask: Mask) -> NDArray[np.uint8]:
        """Return the image (256, 256) of a mask (480, 640)."""
        (image,) = shrink(pack(mask)[None])
        return np.asarray(image, np.uint8)

    def restart(self) -> None:
        """An image does not depend on the one before."""


class Fields(FieldReader):
    """Marker fields (3, 32, 32), whose markers are followed from frame to frame."""

    reference: NDArray[np.uint8] | None = None

    def of(self, mask: Mask) -> NDArray[np.float32]:
        """Return displacement [px] and growth (3, 32, 32) of the next mask (480, 640)."""
        match = self._matcher.step(mask)
        values = np.concatenate([match.moved, match.growth[:, None]], axis=1)
        field = (self._map_operator @ values).T.reshape(3, MAP_SIDE, MAP_SIDE)
        return np.ascontiguousarray(field, np.float32)

    def restart(self) -> None:
        """Expect the next mask to look like the reference."""
        self._matcher.restart()


# Whether a sensor is touched, told from its markers: has any edge of one moved?
#
# The share of pixels in which a mask differs from the untouched one, over the length of the
# markers' edges, is how far those edges moved on average [px]. What it is in the frames that the
# untouched mask was taken from is the noise. Contact is above twice that and a little more; contact
# has ended after a few frames in a row below, so that a press that passes through its untouched
# look does not lose its history.


@dataclass(frozen=True, slots=True)
class ContactRule:
    """When a sensor counts as touched."""

    times_noise: float = 2.0
    """Of the largest motion among the untouched frames."""
    least_px: float = 0.02
    """And so much more, mean motion of the markers' edges [px of 640 x 480]."""
    frames: int = 5
    """Contact has ended after so many frames in a row below."""
    noise_px: float = 0.5
    """Untouched frames that differ by more are not untouched."""

    def __post_init__(self) -> None:
        """Refuse a rule by which nothing ever ends, or all is contact."""
        if not (self.times_noise >= 1 and self.least_px > 0 and self.frames >= 1):
            raise LearningError(
                f"contact: found {self}; allowed: times_noise 1 or more, least_px above 0, frames "
                "1 or more"
            )


class Contact:
    """Follows the masks of one sensor: is it touched?"""

    def __init__(self, untouched: NDArray[np.bool_], rule: ContactRule | None = None) -> None:
        """Take the untouched mask and its noise from frames without contact.

        Args:
            untouched: Masks (n, 480, 640), one or more.
            rule: When it counts as touched.

        Raises:
            LearningError: No markers, or frames that differ too much to be untouched.
        """
        self._rule = rule or ContactRule()
        self.reference: Mask = np.asarray(2 * untouched.sum(axis=0) > len(untouched), np.bool_)
        """What most of them show (480, 640)."""
        self._edge = _edge_length(self.reference)
        if not self._edge:
            raise LearningError("untouched frames: found no markers; allowed: another preset")
        noise = max(self.moved(mask) for mask in untouched)
        if noise > self._rule.noise_px:
            raise LearningError(
                f"untouched frames: their markers move by {noise:.2f} px; allowed: "
                f"{self._rule.noise_px} px; was the sensor touched while its reference was taken?"
            )
        self.threshold_px = self._rule.times_noise * noise + self._rule.least_px
        """Mean motion of edges above which it is touched [px]."""
        self._still = self._rule.frames
        self.motion_px = 0.0
        """Mean motion of the markers' edges in the last frame [px]."""

    def moved(self, mask: Mask) -> float:
        """Return how far the markers' edges lie from where they are untouched, on average [px]."""
        return float(np.count_nonzero(mask != self.reference)) / self._edge

    def step(self, mask: Mask) -> bool:
        """Return whether the sensor is touched in the next frame (480, 640)."""
        self.motion_px = self.moved(mask)
        self._still = 0 if self.motion_px > self.threshold_px else self._still + 1
        return self._still < self._rule.frames


def _edge_length(mask: Mask) -> int:
    """Return the number of sides that pixels of markers share with others."""
    across = np.count_nonzero(mask[:, 1:] != mask[:, :-1])
    down = np.count_nonzero(mask[1:] != mask[:-1])
    return int(across + down)


Frame = NDArray[Any]

# What may step a model: ONNX Runtime and OpenVINO the exported one, torch the trained one.
RUNTIMES = ("onnx", "openvino", "openvino-bf16", "torch")
# Untouched frames that the reference is taken from.
START_FRAMES = 10
_TAXELS = (16, 3)


@dataclass(frozen=True, slots=True)
class LiveForce:
    """What one frame says."""

    force: tuple[float, float, float]
    """Fx, Fy, Fz on the sensor [N]; pressing is negative Fz."""
    contact: bool
    """Whether the sensor is touched; if not, the force is what the network says of an untouched
    sensor."""
    motion_px: float
    """Mean motion of the markers' edges [px of 640 x 480]."""


class Masks(Protocol):
    """Makes masks from what a sensor sends."""

    def untouched(self, frames: NDArray[Any]) -> NDArray[np.bool_]:
        """Return masks (n, 480, 640) of frames without contact, and remember what they are."""

    def mask(self, frame: Frame) -> NDArray[np.bool_]:
        """Return the mask (480, 640) of a frame."""


class LivePredictor:
    """Frame after frame in, force after force out."""

    def __init__(
        self,
        network: ForceStream,
        chosen: Preset,
        *,
        rule: ContactRule | None = None,
        start_frames: int = START_FRAMES,
    ) -> None:
        """Begin before the first frame.

        Args:
            network: The force model, step by step.
            chosen: How markers are found in pictures or drawn from taxels.
            rule: When the sensor counts as touched.
            start_frames: Untouched frames that the reference is taken from.

        Raises:
            LearningError: No frames to begin with.
        """
        if start_frames < 1:
            raise LearningError(f"start_frames: found {start_frames}; allowed: 1 or more")
        self._network = network
        self._masks: Masks = (
            _PictureMasks(chosen) if isinstance(chosen, CameraPreset) else _TaxelMasks(chosen)
        )
        self._rule, self._start_frames = rule, start_frames
        self._first: list[Frame] = []
        self._contact: Contact | None = None
        self._shown: Shown | None = None

    @property
    def reference(self) -> NDArray[np.bool_] | None:
        """The untouched mask (480, 640); None as long as it is not known."""
        return None if self._contact is None else self._contact.reference

    def begin(self, frames: NDArray[Any]) -> None:
        """Take the untouched sensor from frames without contact, and forget what was before.

        Args:
            frames: Pictures (n, h, w, 3) uint8, RGB, or counts of taxels (n, 16, 3).

        Raises:
            LearningError: No such frames, no markers in them, or frames that are not untouched.
        """
        if not len(frames):
            raise LearningError("untouched frames: found none; allowed: one or more")
        self._contact = Contact(self._masks.untouched(frames), self._rule)
        self._shown = shown_to(self._network, self._contact.reference)
        self._network.reset(self._shown.reference)
        self._first.clear()

    def step(self, frame: Frame) -> LiveForce | None:
        """Return the force of the next frame; None while the untouched sensor is looked at.

        Args:
            frame: Picture (h, w, 3) uint8, RGB, or counts of taxels (16, 3).

        Raises:
            LearningError: Another shape, no markers, or a sensor that was touched at the beginning.
        """
        if self._contact is None or self._shown is None:
            self._first.append(np.array(frame))
            if len(self._first) >= self._start_frames:
                self.begin(np.stack(self._first))
            return None
        mask = self._masks.mask(frame)
        contact = self._contact.step(mask)
        if not contact:
            self._network.reset()
            self._shown.restart()
        x, y, z = self._network.step(self._shown.of(mask)).tolist()
        return LiveForce((x, y, z), contact, self._contact.motion_px)


def open_live(
    model: str | os.PathLike[str],
    *,
    runtime: str = RUNTIMES[0],
    sensor: str | None = None,
    preset_name: str | None = None,
    threads: int = 0,
) -> LivePredictor:
    """Return the predictor of a finished force model.

    Args:
        model: Its folder.
        runtime: One of `RUNTIMES`; `python -m learning export-onnx` exports a model.
        sensor: Name of the sensor, which tells the preset.
        preset_name: Name or YAML file of the preset, in place of that.
        threads: Of a step; 0: what the runtime thinks best.

    Raises:
        LearningError: No such model or preset, or no preset is meant for the sensor.
    """
    chosen = preset_name or (None if sensor is None else preset_of_sensor(sensor))
    if chosen is None:
        raise LearningError(
            f"preset: none is meant for sensor {sensor}; allowed: say one (docs/markers.md)"
        )
    one_thread()
    return LivePredictor(_stream(model, runtime, threads), preset(chosen))


def _stream(model: str | os.PathLike[str], runtime: str, threads: int) -> ForceStream:
    if runtime == "onnx":
        return open_exported(model, threads=threads)
    if runtime in ("openvino", "openvino-bf16"):
        bf16 = runtime.endswith("bf16")
        return open_exported(model, runtime="openvino", threads=threads, bf16=bf16)
    if runtime != "torch":
        raise LearningError(f"runtime: found {runtime!r}; allowed: {', '.join(RUNTIMES)}")
    import torch

    from learning.force.export import torch_stream
    from learning.force.predict import load_force_model

    if threads:
        torch.set_num_threads(threads)
    return torch_stream(load_force_model(model))


class _PictureMasks:
    """Markers in pictures of a camera."""

    def __init__(self, chosen: CameraPreset) -> None:
        self._segmenter = Segmenter(chosen)

    def untouched(self, frames: NDArray[Any]) -> NDArray[np.bool_]:
        """Return the masks (n, 480, 640) of pictures (n, h, w, 3)."""
        return np.stack([self.mask(frame) for frame in frames])

    def mask(self, frame: Frame) -> NDArray[np.bool_]:
        """Return the mask (480, 640) of a picture (h, w, 3)."""
        return self._segmenter.mask(frame)


class _TaxelMasks:
    """Discs of taxels, whose counts are relative to the mean of the untouched ones."""

    def __init__(self, chosen: Preset) -> None:
        if isinstance(chosen, CameraPreset):
            raise LearningError("preset: found one of a camera; allowed: one of taxels")
        self._preset = chosen
        self._rest = np.zeros(_TAXELS)

    def untouched(self, frames: NDArray[Any]) -> NDArray[np.bool_]:
        """Return the masks (n, 480, 640) of counts (n, 16, 3)."""
        self._rest = _counts(frames[0], frames).mean(axis=0)
        return taxel_masks(frames, self._rest, self._preset)

    def mask(self, frame: Frame) -> NDArray[np.bool_]:
        """Return the mask (480, 640) of counts (16, 3)."""
        return taxel_masks(_counts(frame, frame), self._rest, self._preset)


def _counts(frame: Frame, values: NDArray[Any]) -> NDArray[np.float64]:
    counts = np.asarray(values, np.float64)
    if frame.shape != _TAXELS or not np.isfinite(counts).all():
        raise LearningError(f"taxels: found {frame.shape}; allowed: finite counts {_TAXELS}")
    return counts
