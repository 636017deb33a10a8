"""Import of published folders to a marker archive: the three layouts.

Training data, a folder of packed masks for each contact point:

    img/npy/<Sensor>/<indenter>/<point>/%04d.npy, last.csv     (or img/<Sensor>/..., .jpg)
    img/npy/<Sensor>_ref.npy                                   (or .jpg)
    img/npy_csv/<Sensor>/<indenter>/<point>/last.csv           (if it is not next to the masks)
    force/<Sensor>/<indenter>/<point>/ft.csv
    depth/<Sensor>/<indenter>/<point>/inc_z.csv, dec_z.csv     (not in the homogeneous test)

Frames are numbered through all four phases; last.csv names the last frame of each.

Simulated states, pictures of a pattern by place and depth [mm]:

    <Pattern>_ref.jpg
    <indenter>/<Pattern>/<x>_<y>_<depth>.jpg

A raw run as it was collected, pictures or taxels, forces and poses, phase by phase:

    <sensor>/image/<indenter>-<YYYYmmdd_HHMMSS>/<point>/<phase>/%04d.jpg, ref.jpg above the points
    <sensor>/uskin_raw/<run>/<point>/<phase>/%04d.npy                     counts minus ref.npy
    <sensor>/force/<run>/<point>/<phase>/ft.csv
    <sensor>/pose/<run>/<point>/<phase>/pose.csv

Its phases are normal_inc, shear_inc, shear_dec, normal_dec; down and up in force-depth runs.
"""

import functools
import json
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.config import READER
from learning.data.genforce.format import (
    SUFFIXES,
    Array,
    Compensation,
    GenForcePress,
    Packed,
    ReadMask,
    read_counts,
    read_depths,
    read_forces,
    read_mask,
    read_phases,
    read_picture,
    read_poses,
    read_reference,
)
from learning.data.genforce.turns import turn_of
from learning.errors import LearningError
from learning.indenters import UNSEEN, coded
from learning.markers.frames import FLAG, marker_flags, taxel_masks
from learning.markers.pattern import ReferenceMarkers, with_reference
from learning.markers.segment import (
    CameraPreset,
    Segmenter,
    ShadingPreset,
    TaxelPreset,
    preset,
    preset_of_sensor,
)
from recorder.archive import (
    CHUNK_ROWS,
    NO_PHASE,
    UNIT_ROWS,
    Frames,
    MarkerCount,
    SensorPlan,
    fill_archive,
)
from recorder.convert import DEPTH_UNKNOWN
from recorder.markers import pack, smallest_marker, unpack
from recorder.spec import PHASES
from trajectories import PressShear, Target, plan_to_json

# Default size of a pixel of the authors' GelSights [mm].
MM_PER_PX = 0.0249
TAXELS_MM_PER_PX = 0.03671875
# Surface heights of the authors' heterogeneous test, where depth is 0 [mm]: these files hold
# heights, normalised by these values. Elsewhere the files hold depths.
SURFACES_MM: Mapping[str, float] = {"uskin": 1.08649, "tactip": 4.648126681, "gelsight": 1.12310475}
# Correlation with the force that shows which they hold, and how far the surface of a published
# sensor may be from where force begins [m].
_SIGN, _NEAR_SURFACE = 0.5, 3e-4
NO_LOCATION = -1
# Value of `t_ns`: the folders have no times.
NO_TIME = 0


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
    """Plans of sensors in a training folder: the number of a press gives its place, direction and
    depth."""
    unseen: tuple[str, ...] = UNSEEN
    """Indenters that models may not be trained on."""
    compensation: Mapping[str, Compensation] = field(default_factory=dict)
    """Force over depth by sensor, stored with it."""
    turns_deg: Mapping[str, float] = field(default_factory=dict)
    """Angle from the robot's x axis to the image's, counter-clockwise, by raw sensor [deg].

    Poses of a run are in the robot's frame, and how the sensor stood there is not stored."""


@dataclass(frozen=True, slots=True, eq=False)
class PublishedSensor:
    """One sensor of a folder; implements `recorder.archive.SensorFrames`."""

    plan: SensorPlan
    files: tuple[Path, ...]
    read_mask: ReadMask
    """Reads the packed mask (38400,) of a frame's file."""
    table: Mapping[str, NDArray[Any]]
    """Labels of all frames by column."""
    lines: Sequence[Mapping[str, Any]]
    """Provenance of each frame."""

    def read(self, rows: slice) -> Frames:
        """Read some of the frames."""
        plan, table = self.plan, {name: values[rows] for name, values in self.table.items()}
        frames = np.stack([self.read_mask(path) for path in self.files[rows]])
        flags = marker_flags(plan.name, frames, table, plan.references, plan.marker_count)
        lines = [
            {**line, **({FLAG: flags[row]} if row in flags else {})}
            for row, line in enumerate(self.lines[rows])
        ]
        return Frames(frames, table, [json.dumps(line, ensure_ascii=False) for line in lines])


@dataclass(frozen=True, slots=True)
class _Folder:
    root: Path
    """Provenance gives files relative to it."""
    indenters: tuple[str, ...]
    """Names, by code; locations are numbered by the codes."""
    chosen: Choices

    def sensor(
        self,
        name: str,
        presses: Sequence[GenForcePress],
        references: Packed,
        about: Mapping[str, Any],
        *,
        read: ReadMask = read_mask,
        count: MarkerCount | None = None,
    ) -> PublishedSensor:
        """Return a sensor with attributes `about` and packed references (K, 38400)."""
        taxels = "uskin" in name.lower()
        attrs: dict[str, Any] = {
            "made_from": self.root.name,
            "times": "none: t_ns is 0; frames are in the order of their numbers",
            **about,
        }
        if name in self.chosen.compensation:
            attrs["force_depth"] = asdict(self.chosen.compensation[name])
        if count is None and not taxels:
            # Markers of a mask are counted, but neither their fragments nor the discs of taxels,
            # which may merge.
            count = MarkerCount(min(smallest_marker(mask) for mask in unpack(references)))
        default_mm = TAXELS_MM_PER_PX if taxels else MM_PER_PX
        plan = SensorPlan(
            name=name,
            rows=sum(len(press) for press in presses),
            chunk_rows=CHUNK_ROWS,
            unit_rows=UNIT_ROWS,
            references=references,
            mm_per_px=self.chosen.mm_per_px.get(name, default_mm),
            marker_count=count,
            attrs=attrs,
        )
        parts = [self._table(press) for press in presses]
        table = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
        files = tuple(file for press in presses for file in press.files)
        folders = [press.files[0].parent.relative_to(self.root).as_posix() for press in presses]
        lines = [
            {"folder": folder, "target": press.target}
            for folder, press in zip(folders, presses, strict=True)
            for _ in press.files
        ]
        return PublishedSensor(plan, files, read, table, lines)

    def _table(self, press: GenForcePress) -> dict[str, NDArray[Any]]:
        count = len(press)
        return {
            "indenter": np.full(count, self.indenters.index(press.indenter)),
            "seen": np.full(count, press.indenter not in self.chosen.unseen),
            "location": press.location,
            "target": np.full(count, press.target),
            "phase": press.phase,
            "depth": press.depth,
            "position": press.position,
            "wrench": press.wrench,
            "frame": np.arange(count),
            "t_ns": np.full(count, NO_TIME),
            "reference": np.full(count, press.reference),
            "valid": np.ones(count, np.bool_),
        }


def read_plan(path: Path) -> PressShear:
    """Read the plan of presses in a bench file or a simulated sensor's file, its `trajectory`."""
    content = READER.read(path)
    if "trajectory" not in content:
        raise LearningError(f"{path}: missing trajectory; allowed: a press_shear plan")
    return READER.build(PressShear, content["trajectory"], f"{path}.trajectory")


def layout_of(root: Path) -> str:
    """Return the layout of a folder: `training`, `states` or `raw`."""
    if not root.is_dir():
        raise LearningError(f"{root}: no such folder")
    if (root / "img").is_dir():
        return "training"
    if any(root.glob("*_ref.*")) and not (root / "img").exists():
        return "states"
    if _raw_folders(root):
        return "raw"
    raise LearningError(
        f"{root}: found no img, no <Pattern>_ref.jpg and no image/<indenter>-<date>_<time>; "
        "expected one of the layouts training, states, raw"
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
    indenters = coded(_indenters(layout, root))
    sensors = list(read(_Folder(root, indenters, chosen)))
    attrs = {"made_from": f"GenForce folder, layout {layout}"}
    return fill_archive(out, sensors, indenters, attrs, progress)


def _indenters(layout: str, root: Path) -> set[str]:
    if layout == "raw":
        return {_indenter(run) for sensor in _raw_folders(root) for run in _runs(sensor)}
    sensors = _folders(_images(root)) if layout == "training" else [root]
    return {one.name for sensor in sensors for one in _folders(sensor)}


def _folders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")


def _contact_points(folder: Path) -> list[Path]:
    """Return the folders of contact points by number."""
    points = _folders(folder)
    for point in points:
        if not point.name.isdecimal() or int(point.name) < 1:
            raise LearningError(f"{point}: found no number; expected contact points 1, 2, ...")
    if not points:
        raise LearningError(f"{folder}: found no contact points; expected folders 1, 2, ...")
    return sorted(points, key=lambda point: int(point.name))


def _targets(folders: Iterable[Path]) -> int:
    """Return the largest number of a contact point in folders of them."""
    return max(int(point.name) for folder in folders for point in _contact_points(folder))


def _frame_files(folder: Path) -> tuple[Path, ...]:
    files = [path for path in folder.iterdir() if path.suffix in SUFFIXES]
    files = sorted(path for path in files if path.stem.isdecimal())
    if not files:
        raise LearningError(f"{folder}: found no frames; expected 0000.npy or 0000.jpg and so on")
    if len({path.suffix for path in files}) > 1:
        raise LearningError(f"{folder}: found .npy and .jpg; expected one kind")
    for number, path in enumerate(files):
        if int(path.stem) != number:
            raise LearningError(f"{folder}: found {path.name}; expected frame {number:04d}")
    return tuple(files)


def _forces(folder: Path, place: Path, files: tuple[Path, ...]) -> tuple[Array, bool]:
    """Return wrenches (n, 6), NaN if the sensor has no forces, and True if they include torques."""
    if not folder.is_dir():
        return np.full((len(files), 6), np.nan), True
    return read_forces(folder / place / "ft.csv", files)


# Training data. A folder has the ends of phases, but no times; places and depths are in a plan.

_BY_PLAN = "the plan, by the number of the press; evenly spaced within a phase"


def _training(folder: _Folder) -> Iterator[PublishedSensor]:
    root, plans = folder.root, folder.chosen.plans
    images = _images(root)
    sensors = _folders(images)
    names = [sensor.name for sensor in sensors]
    if unknown := sorted(set(plans) - set(names)):
        raise LearningError(
            f"plan: found one of {', '.join(unknown)}; {root} has {', '.join(names)}"
        )
    if not sensors:
        raise LearningError(f"{images}: found no folder of a sensor")
    for sensor in sensors:
        if not _folders(sensor):
            raise LearningError(f"{sensor}: found no folder of an indenter")
    targets = _targets(one for sensor in sensors for one in _folders(sensor))
    yield from (_training_sensor(folder, images, sensor, targets) for sensor in sensors)


def _training_sensor(folder: _Folder, images: Path, sensor: Path, targets: int) -> PublishedSensor:
    root, name, chosen = folder.root, sensor.name, folder.chosen
    reference = read_reference(images / f"{name}_ref", ".npy")
    plan = chosen.plans.get(name)
    planned = () if plan is None else tuple(plan.targets())
    presses, torques = [], True
    have_depths: set[bool] = set()
    for indenter in _folders(sensor):
        code = folder.indenters.index(indenter.name)
        for point in _contact_points(indenter):
            files = _frame_files(point)
            subfolder = Path(indenter.name) / point.name
            wrench, whole = _forces(root / "force" / name, subfolder, files)
            depth = _depth(root / "depth" / name / subfolder, files)
            have_depths.add(depth is not None)
            torques &= whole
            target = int(point.name) - 1
            count = len(files)
            phase = read_phases(_last(images, name / subfolder), count)
            tip = np.zeros((count, 3))
            if plan is not None:
                if target >= len(planned):
                    raise LearningError(
                        f"{point}: found press {target + 1}; its plan has {len(planned)}"
                    )
                tip = _along(plan, planned[target], phase)
                depth = np.maximum(-tip[:, 2], 0.0) if depth is None else depth
            presses.append(
                GenForcePress(
                    indenter=indenter.name,
                    target=target,
                    files=files,
                    phase=phase,
                    wrench=wrench,
                    depth=np.zeros(count) if depth is None else depth,
                    position=tip[:, :2],
                    location=np.full(count, code * targets + target),
                )
            )
    if len(have_depths) > 1:
        raise LearningError(f"{root / 'depth' / name}: has depths of some points; expected of all")
    depths = DEPTH_UNKNOWN if plan is None else _BY_PLAN
    if have_depths == {True}:
        depths = "inc_z.csv and dec_z.csv, mm"
        surface, why = _surface(presses, name, chosen.surfaces_mm.get(name))
        if surface is not None:
            depths += f" below {1e3 * surface:.4g} mm{why}"
            presses = [replace(press, depth=surface - press.depth) for press in presses]
        presses = [replace(press, depth=np.maximum(press.depth, 0.0)) for press in presses]
    about: dict[str, Any] = {
        "depth": depths,
        "position": "unknown: 0" if plan is None else _BY_PLAN,
        **({} if plan is None else {"plan": plan_to_json(plan)}),
        **({} if torques else {"torque": "unknown: 0"}),
    }
    return folder.sensor(name, presses, reference[None], about)


def _along(plan: PressShear, target: Target, phase: NDArray[np.int64]) -> Array:
    """Return the planned tip at each frame of a press (n, 3) [m], z above the surface there.

    The last frame of a phase is at its end; those before are evenly spaced.
    """
    tip = np.empty((len(phase), 3))
    for move in plan.moves(target):
        rows = np.flatnonzero(phase == move.phase)
        way = np.linspace(0.0, 1.0, len(rows) + 1)[1:, None]
        tip[rows] = (1 - way) * np.array(move.start) + way * np.array(move.end)
    tip[:, 2] -= plan.height(*target.origin[:2])
    return tip


def _images(root: Path) -> Path:
    return next(path for name in ("npy", "jpg", "") if (path := root / "img" / name).is_dir())


def _last(images: Path, place: Path) -> Path:
    beside = images / place / "last.csv"
    apart = images.with_name(f"{images.name}_csv") / place / "last.csv"
    return apart if apart.exists() and not beside.exists() else beside


def _depth(folder: Path, files: tuple[Path, ...]) -> Array | None:
    """Return depths or heights (n,) [m], or None if there are none."""
    if not folder.is_dir():
        return None
    down, up = read_depths(folder / "inc_z.csv"), read_depths(folder / "dec_z.csv")
    values = np.concatenate([down, up])
    if len(values) != len(files):
        raise LearningError(
            f"{folder}: inc_z.csv and dec_z.csv have {len(down)} and {len(up)} values; "
            f"{files[0].parent} has {len(files)} frames"
        )
    return np.asarray(values * 1e-3, np.float64)


def _surface(
    presses: Sequence[GenForcePress], name: str, stated_mm: float | None
) -> tuple[float | None, str]:
    """Return the height of the surface [m] and why, if depth files hold heights; None for depths.

    Heights fall while force rises, and are the surface's where the force begins.
    """
    agree, begins = [0.0], []
    for press in presses:
        force = np.linalg.norm(press.wrench[:, :3] - press.wrench[0, :3], axis=1)
        some = np.flatnonzero((press.phase == 0) & (force > 0.02 * force.max()))
        if len(some) > 2 and np.ptp(press.depth[some]) > 0:
            agree.append(float(np.corrcoef(press.depth[some], force[some])[0, 1]))
            # Hertz's power of the force is linear in depth; a punch's would be 1.
            some = some[: max(3, len(some) // 2)]
            begins.append(float(np.polyfit(force[some] ** (2 / 3), press.depth[some], 1)[1]))
    sign = float(np.median(agree[1:] or agree))
    if stated_mm is not None and sign > _SIGN:
        raise LearningError(
            f"{name}: its depth files rise with the force (correlation {sign:.2f}), so they hold "
            "depths; allowed: no height of the surface"
        )
    if stated_mm is not None or sign > -_SIGN:
        return None if stated_mm is None else 1e-3 * stated_mm, ""
    surface, half = float(np.median(begins)), 1.96 * float(np.std(begins)) / len(begins) ** 0.5
    published = 1e-3 * SURFACES_MM.get(name.lower(), math.inf)
    surface = published if abs(published - surface) < _NEAR_SURFACE else surface
    return surface, (
        f" (± {1e3 * half + 0.02:.2g} mm, 95 %): heights, as they fall while force rises, of a "
        "surface where that begins"
    )


# Simulated states. Places are numbered by x, then y, depths in ascending order, over all files; a
# location is a place and a depth. Simulated archives are numbered in the same way.

_NUMBER = r"-?\d+(?:\.\d+)?"
_STATE = re.compile(rf"({_NUMBER})_({_NUMBER})_({_NUMBER})")


def _states(folder: _Folder) -> Iterator[PublishedSensor]:
    root = folder.root
    names = sorted(path.stem.removesuffix("_ref") for path in root.glob("*_ref.*"))
    shapes = sorted(_indenters("states", root))
    files = {(shape, name): _state_files(root / shape / name) for shape in shapes for name in names}
    every = {state for states in files.values() for state in states}
    if not every:
        raise LearningError(f"{root}: found no <indenter>/<Pattern>/<x>_<y>_<depth>.jpg")
    points = sorted({state[:2] for state in every})
    depths = sorted({state[2] for state in every})
    for name in names:
        presses = []
        for shape in shapes:
            states = files[shape, name]
            for target, (x, y) in enumerate(points):
                here = [depth for depth in depths if (x, y, depth) in states]
                if not here:
                    continue
                first = (folder.indenters.index(shape) * len(points) + target) * len(depths)
                presses.append(
                    GenForcePress(
                        indenter=shape,
                        target=target,
                        files=tuple(states[x, y, depth] for depth in here),
                        phase=np.full(len(here), NO_PHASE),
                        wrench=np.full((len(here), 6), np.nan),
                        depth=np.array(here) * 1e-3,
                        position=np.tile(np.array((x, y)) * 1e-3, (len(here), 1)),
                        location=np.array([first + depths.index(depth) for depth in here]),
                    )
                )
        reference = read_reference(root / f"{name}_ref", ".jpg")
        if not presses:
            raise LearningError(f"{root}: found {name}_ref, and no pictures of it")
        about = {"depth": "names of files, mm", "position": "names of files, mm"}
        yield folder.sensor(name, presses, reference[None], about)


def _state_files(folder: Path) -> dict[tuple[float, float, float], Path]:
    """Return the files in a folder by x, y and depth [mm]."""
    if not folder.is_dir():
        return {}
    states: dict[tuple[float, float, float], Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix not in SUFFIXES:
            continue
        named = _STATE.fullmatch(path.stem)
        if named is None:
            raise LearningError(f"{path}: expected a name <x>_<y>_<depth>{path.suffix}, in mm")
        x, y, depth = (float(number) for number in named.groups())
        if depth < 0 or (x, y, depth) in states:
            raise LearningError(f"{path}: found a depth below 0, or a duplicate state")
        states[x, y, depth] = path
    return states


# Raw runs. Depth is measured downwards from the first pose of the press, position from the first
# pose of the run.

_RUN = re.compile(r"(.+)-\d{8}_\d{6}")
# Phases, and those of force-depth runs, with their codes.
_PHASES = {name: code for code, name in enumerate(PHASES)}
_FORCE_DEPTH = {"down": _PHASES["normal_inc"], "up": _PHASES["normal_dec"]}
# Positions of a raw run whose sensor may be turned against the robot; `archive join` refuses them.
TURN_UNKNOWN = (
    "unknown turn: pose.csv, from the first pose of the run along the axes of the robot; import "
    "with --turn SENSOR=DEG"
)
TURNED = "pose.csv: from the first pose of the run, turned by"


def _raw(folder: _Folder) -> Iterator[PublishedSensor]:
    sensors, turns = _raw_folders(folder.root), folder.chosen.turns_deg
    names = [sensor.name for sensor in sensors]
    if unknown := sorted(set(turns) - set(names)):
        raise LearningError(f"turn: found {', '.join(unknown)}; allowed: {', '.join(names)}")
    targets = _targets(run for sensor in sensors for run in _runs(sensor))
    yield from (_raw_sensor(folder, sensor, targets) for sensor in sensors)


def _raw_folders(root: Path) -> list[Path]:
    """Return the folders of sensors: one, or those in it."""
    some = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
    return [path for path in some if _runs(path)]


def _runs(sensor: Path) -> list[Path]:
    for modality in ("image", "uskin_raw"):
        if (sensor / modality).is_dir():
            return sorted(
                path for path in (sensor / modality).iterdir() if _RUN.fullmatch(path.name)
            )
    return []


def _indenter(run: Path) -> str:
    return run.name.rpartition("-")[0]


def _raw_sensor(folder: _Folder, sensor: Path, targets: int) -> PublishedSensor:
    name, chosen = sensor.name, folder.chosen
    taxels = not (sensor / "image").is_dir()
    presses: list[GenForcePress] = []
    pictures: list[Path] = []
    earlier: dict[tuple[str, bool], Path] = {}
    for number, run in enumerate(_runs(sensor)):
        if not taxels:
            pictures.append(run / "ref.jpg")
            if not pictures[-1].is_file():
                raise LearningError(
                    f"{pictures[-1]}: no such file; expected the reference without contact"
                )
        located = not (_contact_points(run)[0] / "down").is_dir()
        other = earlier.setdefault((_indenter(run), located), run)
        if other is not run:
            raise LearningError(
                f"{run}: found {_indenter(run)}, as in {other.name}; expected one run for an "
                "indenter"
            )
        presses += _raw_presses(folder, sensor, run, located, targets, 0 if taxels else number)
    preset_name = chosen.preset_name or preset_of_sensor(name)
    if preset_name is None:
        raise LearningError(f"{name}: no preset is assigned to it; allowed: --preset NAME")
    settings = preset(preset_name)
    if isinstance(settings, ShadingPreset) or isinstance(settings, TaxelPreset) != taxels:
        kind = "taxels" if taxels else "pictures"
        raise LearningError(f"preset {preset_name}: is for {settings.KIND}; {name} has {kind}")
    count = None
    if isinstance(settings, TaxelPreset):
        read: ReadMask = functools.partial(_discs, settings)
        still = pack(taxel_masks(np.zeros((1, 16, 3)), np.zeros((16, 3)), settings))
    else:
        read = _segmented(settings, pictures)
        still = np.stack([read(path) for path in pictures])
        count = MarkerCount(settings.area_px[0], settings.tolerance)
    position = TURN_UNKNOWN
    if name in chosen.turns_deg:
        position = f"{TURNED} {chosen.turns_deg[name]:g} deg into the image as stated"
        presses = _turned(presses, math.radians(chosen.turns_deg[name]))
    elif not taxels and (turn := turn_of(name, presses, still, read)) is not None:
        position = f"{TURNED} {turn}"
        presses = _turned(presses, turn.angle)
    about: dict[str, Any] = {
        "depth": "pose.csv: below the first pose of the press",
        "position": position,
        "preset": preset_name,
    }
    return folder.sensor(name, presses, still, about, read=read, count=count)


def _raw_presses(
    folder: _Folder, sensor: Path, run: Path, located: bool, targets: int, reference: int
) -> Iterator[GenForcePress]:
    """Yield the presses of a run, with positions along the axes of the robot."""
    phases = _PHASES if located else _FORCE_DEPTH
    indenter = _indenter(run)
    origin: Array | None = None
    for point in _contact_points(run):
        target = int(point.name) - 1
        files: list[Path] = []
        codes: list[int] = []
        wrenches: list[Array] = []
        poses: list[Array] = []
        for phase, code in phases.items():
            if not (point / phase).is_dir():
                raise LearningError(
                    f"{point / phase}: no such folder; expected {', '.join(phases)}"
                )
            some = _frame_files(point / phase)
            files += some
            codes += [code] * len(some)
            subfolder = Path(run.name) / point.name / phase
            wrenches.append(_forces(sensor / "force", subfolder, some)[0])
            poses.append(read_poses(sensor / "pose" / subfolder / "pose.csv", some))
        pose = np.concatenate(poses)
        origin = pose[0] if origin is None else origin
        location = folder.indenters.index(indenter) * targets + target if located else NO_LOCATION
        yield GenForcePress(
            indenter=indenter,
            target=target if located else targets + target,
            files=tuple(files),
            phase=np.array(codes),
            wrench=np.concatenate(wrenches),
            depth=np.maximum(pose[0, 2] - pose[:, 2], 0.0),
            position=pose[:, :2] - origin[:2],
            location=np.full(len(files), location),
            reference=reference,
        )


def _turned(presses: Iterable[GenForcePress], angle: float) -> list[GenForcePress]:
    """Return presses whose positions are turned into an image, by the angle of its x axis [rad]."""
    cosine, sine = math.cos(-angle), math.sin(-angle)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    return [replace(press, position=press.position @ turn) for press in presses]


def _segmented(settings: CameraPreset, references: Collection[Path]) -> ReadMask:
    segmenter = Segmenter(settings)

    @functools.lru_cache(maxsize=1)
    def finder(reference: Path | None) -> Segmenter | ReferenceMarkers:
        if reference is None:
            return segmenter
        return with_reference(segmenter, segmenter.view(read_picture(reference)))

    def read(path: Path) -> Packed:
        run = path.parents[:3]
        own = next((one for one in references if one != path and one.parent in run), None)
        return pack(finder(own).mask_of_view(segmenter.view(read_picture(path))))

    return read


def _discs(settings: TaxelPreset, path: Path) -> Packed:
    (packed,) = pack(taxel_masks(read_counts(path)[None], np.zeros((16, 3)), settings))
    return np.asarray(packed, np.uint8)
