"""Import of published folders to a marker archive."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from learning.archive_writer import SensorFrames, fill_archive
from learning.data.genforce import raw, states, training
from learning.data.genforce.format import (
    Compensation,
    GenForcePress,
    Packed,
    PublishedSensor,
    ReadMask,
    read_mask,
)
from learning.data.genforce.turns import turn_of
from learning.errors import LearningError
from learning.indenters import UNSEEN, coded
from learning.markers.frames import taxel_masks
from learning.markers.lattice import Lattice, with_reference
from learning.markers.segment import (
    CameraPreset,
    Segmenter,
    ShadingPreset,
    TaxelPreset,
    preset,
    preset_of_sensor,
)
from recorder.archive import MarkerCount
from recorder.markers import pack, smallest_marker, unpack
from recorder.settings import Reader
from trajectories import PressShear, plan_to_json

# Supported layouts and their descriptions.
LAYOUTS: Mapping[str, str] = {
    "training": "packed masks a contact point, with forces and depths",
    "states": "simulated pictures by place and depth",
    "raw": "a run as it was collected: pictures or taxels, forces, poses",
}
# Default size of a pixel of the authors' GelSights [mm].
MM_PER_PX = 0.0249
TAXELS_MM_PER_PX = 0.03671875
# Positions of a raw run whose sensor may be turned against the robot; `archive join` refuses them.
TURN_UNKNOWN = (
    "unknown turn: pose.csv, from the first pose of the run along the axes of the robot; import "
    "with --turn SENSOR=DEG"
)
TURNED = "pose.csv: from the first pose of the run, turned by"
_NO_TIMES = "none: t_ns is 0; frames are in the order of their numbers"


@dataclass(frozen=True, slots=True)
class Choices:
    """Options that the folders do not determine."""

    preset_name: str | None = None
    """Preset of marker detection for raw pictures; None: the preset for each sensor."""
    mm_per_px: Mapping[str, float] = field(default_factory=dict)
    """Size of a pixel by sensor [mm]."""
    surfaces_mm: Mapping[str, float] = field(default_factory=dict)
    """Sensors whose depth files hold heights, and the height of their surface [mm]."""
    plans: Mapping[str, PressShear] = field(default_factory=dict)
    """Plans of sensors in a training folder, whose presses are numbered in their order."""
    unseen: tuple[str, ...] = UNSEEN
    """Indenters that models may not be trained on."""
    compensation: Mapping[str, Compensation] = field(default_factory=dict)
    """Force over depth by sensor, stored with it."""
    turns_deg: Mapping[str, float] = field(default_factory=dict)
    """Angle from the robot's x axis to the image's, counter-clockwise, by raw sensor [deg].

    Poses of a run are in the robot's frame, and nothing in it tells how the sensor stood there."""


def read_plan(path: Path) -> PressShear:
    """Read the plan of presses in a bench file or a simulated sensor's file, its `trajectory`.

    Raises:
        LearningError: No such file, or it has no valid press-shear plan.
    """
    reader = Reader(LearningError)
    content = reader.read(path)
    if "trajectory" not in content:
        raise LearningError(f"{path}: missing trajectory; allowed: a press_shear plan")
    return reader.build(PressShear, content["trajectory"], f"{path}.trajectory")


def layout_of(root: Path) -> str:
    """Return the one of `LAYOUTS` that a folder has.

    Raises:
        LearningError: It has none of them, or is not a folder.
    """
    if not root.is_dir():
        raise LearningError(f"{root}: no such folder")
    known = {"training": training.is_training, "states": states.is_states, "raw": raw.is_raw}
    for name, fits in known.items():
        if fits(root):
            return name
    raise LearningError(
        f"{root}: found no img, no <Pattern>_ref.jpg and no image/<indenter>-<date>_<time>; "
        f"expected one of the layouts {', '.join(LAYOUTS)}"
    )


def import_folder(
    root: Path,
    out: Path,
    *,
    choices: Choices | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Make or resume the marker archive of a published folder; return the number of new frames.

    All labels and lists are read first, so an invalid folder is rejected before anything is
    written. Masks are read as they are written.

    Raises:
        LearningError: A file or folder is missing or invalid; the message names it.
        SessionError: Another archive exists at `out`.
        OSError: The disk is full, or not writable.
    """
    chosen = choices or Choices()
    layout = layout_of(root)
    if chosen.turns_deg and layout != "raw":
        raise LearningError(
            f"turn: found with a folder of layout {layout}, whose places are in the image; "
            "allowed: a raw run"
        )
    if chosen.plans and layout != "training":
        raise LearningError(
            f"plan: found with a folder of layout {layout}, which tells places itself; allowed: "
            "a training folder"
        )
    read = {"training": _training, "states": _states, "raw": _raw}[layout]
    of = {"training": training, "states": states, "raw": raw}[layout]
    indenters = coded(of.indenters_of(root))
    sensors: list[SensorFrames] = list(read(root, indenters, chosen))
    attrs = {"made_from": f"GenForce folder, layout {layout}"}
    return fill_archive(out, sensors, indenters, attrs, progress)


def _training(root: Path, indenters: tuple[str, ...], chosen: Choices) -> Iterator[PublishedSensor]:
    for one in training.read_training(root, _codes(indenters), chosen.surfaces_mm, chosen.plans):
        about: dict[str, Any] = {"depth": one.depths, "position": one.positions}
        if one.name in chosen.plans:
            about["plan"] = plan_to_json(chosen.plans[one.name])
        if not one.torques:
            about["torque"] = "unknown: 0"
        yield _published(root, one.name, one.presses, one.reference[None], indenters, chosen, about)


def _states(root: Path, indenters: tuple[str, ...], chosen: Choices) -> Iterator[PublishedSensor]:
    for name, reference, presses in states.read_states(root, _codes(indenters)):
        if not presses:
            raise LearningError(f"{root}: found {name}_ref, and no pictures of it")
        about = {"depth": "names of files, mm", "position": "names of files, mm"}
        yield _published(root, name, presses, reference[None], indenters, chosen, about)


def _raw(root: Path, indenters: tuple[str, ...], chosen: Choices) -> Iterator[PublishedSensor]:
    turns = {name: math.radians(turn) for name, turn in chosen.turns_deg.items()}
    for one in raw.read_raw(root, _codes(indenters), turns):
        name = chosen.preset_name or preset_of_sensor(one.name)
        if name is None:
            raise LearningError(f"{one.name}: no preset is assigned to it; allowed: --preset NAME")
        found = preset(name)
        if isinstance(found, ShadingPreset) or isinstance(found, TaxelPreset) != one.taxels:
            kind = "taxels" if one.taxels else "pictures"
            raise LearningError(f"preset {name}: is for {found.KIND}; {one.name} has {kind}")
        count = None
        if isinstance(found, TaxelPreset):
            read = _taxels(found)
            still = pack(taxel_masks(np.zeros((1, 16, 3)), np.zeros((16, 3)), found))
        else:
            read = _segmented(found, one.references)
            still = np.stack([read(path) for path in one.references])
            count = MarkerCount(found.area_px[0], found.tolerance)
        presses, position = one.presses, TURN_UNKNOWN
        if one.name in chosen.turns_deg:
            position = f"{TURNED} {chosen.turns_deg[one.name]:g} deg into the image as stated"
        elif not one.taxels and (turn := turn_of(one.name, presses, still, read)) is not None:
            presses = raw.turned(presses, turn.angle)
            position = f"{TURNED} {turn}"
        about: dict[str, Any] = {
            "depth": "pose.csv: below the first pose of the press",
            "position": position,
            "preset": name,
        }
        yield _published(
            root, one.name, presses, still, indenters, chosen, about, read=read, count=count
        )


def _published(
    root: Path,
    name: str,
    presses: tuple[GenForcePress, ...],
    references: Packed,
    indenters: tuple[str, ...],
    chosen: Choices,
    about: Mapping[str, Any],
    *,
    read: ReadMask = read_mask,
    count: MarkerCount | None = None,
) -> PublishedSensor:
    taxels = "uskin" in name.lower()
    attrs: dict[str, Any] = {"made_from": root.name, "times": _NO_TIMES, **about}
    if name in chosen.compensation:
        attrs["force_depth"] = asdict(chosen.compensation[name])
    # Markers of a mask are counted, except for the discs of taxels, which may merge.
    return PublishedSensor(
        name=name,
        presses=presses,
        references=references,
        indenters=indenters,
        mm_per_px=chosen.mm_per_px.get(name, TAXELS_MM_PER_PX if taxels else MM_PER_PX),
        read_mask=read,
        root=root,
        unseen=chosen.unseen,
        marker_count=count if count is not None or taxels else _count_of(references),
        attrs=attrs,
    )


def _count_of(references: Packed) -> MarkerCount:
    """Return the marker count of masks from a folder: fragments of markers are not counted."""
    return MarkerCount(min(smallest_marker(mask) for mask in unpack(references)))


def _segmented(found: CameraPreset, references: Collection[Path]) -> ReadMask:
    segmenter = Segmenter(found)

    @functools.lru_cache(maxsize=1)
    def finder(reference: Path | None) -> Segmenter | Lattice:
        if reference is None:
            return segmenter
        return with_reference(segmenter, segmenter.view(raw.read_picture(reference)))

    def read(path: Path) -> Packed:
        run = path.parents[:3]
        own = next((one for one in references if one != path and one.parent in run), None)
        return pack(finder(own).mask_of_view(segmenter.view(raw.read_picture(path))))

    return read


def _taxels(found: TaxelPreset) -> ReadMask:
    def read(path: Path) -> Packed:
        (packed,) = pack(taxel_masks(raw.read_counts(path)[None], np.zeros((16, 3)), found))
        return np.asarray(packed, np.uint8)

    return read


def _codes(indenters: tuple[str, ...]) -> dict[str, int]:
    return {name: code for code, name in enumerate(indenters)}
