"""Plan of an archive, fixed before any data is written; the same plan resumes the archive."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive.arrays import MASKS, ArchiveArray, Representation
from recorder.errors import SessionError
from recorder.markers import SMALLEST_PX, Lattice
from recorder.spec import ARCHIVE_FORMAT
from recorder.store.documents import read_attrs, read_document, write_group
from recorder.store.files import LOCAL, Files, sync_directory
from recorder.store.reader import ColumnReader

FORMAT_VERSION = 1
WRITING, COMPLETE = "writing", "complete"

# Folder of the finished units in the array of the frames, which Zarr readers do not list.
LEDGER = "ledger"

_CREATING = ".creating"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_ARCHIVE_KEYS = ("format", "format_version", "status", "sensors", "indenters")
_SENSOR_KEYS = ("mm_per_px", "marker_check", "displacement_of", "representation")


@dataclass(frozen=True, slots=True)
class MarkerCount:
    """Settings for counting the markers of a sensor in a check."""

    smallest_px: int = SMALLEST_PX
    """Smallest patch that is counted [px]."""
    tolerance: int = 0
    """Number of missing or extra markers allowed beyond those that the image border explains."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorPlan:
    """One sensor of an archive."""

    name: str
    """Name of the sensor's group."""
    rows: int
    """Number of frames."""
    chunk_rows: int
    """Frames per chunk, compressed together: those of one press, if they are few."""
    unit_rows: int
    """Frames per unit, a multiple of `chunk_rows`; the last unit may be shorter."""
    references: NDArray[np.uint8]
    """The sensor without contact (K, ...): packed masks (K, 38400), or as its representation."""
    mm_per_px: float
    """Size of a pixel on the undeformed surface [mm]."""
    lattice: Lattice | None = None
    """Lattice of the stored displacement field; None stores none."""
    displacement_of: str | None = None
    """Name of the sensor whose fields also apply to this one, row by row: a different pattern on
    the same surface, seen by the same camera."""
    marker_count: MarkerCount | None = field(default_factory=MarkerCount)
    """Settings for counting markers; None if the number of patches may vary between frames."""
    attrs: Mapping[str, Any] = field(default_factory=dict)
    """Further JSON-compatible attributes, such as pattern, camera and origin."""
    representation: Representation = MASKS
    """Content of its frames."""

    def __post_init__(self) -> None:
        """Reject plans that the format cannot hold."""
        if not _NAME.fullmatch(self.name):
            raise SessionError(
                f"sensor: found name {self.name!r}; allowed: letters, digits, dot, dash and "
                "underscore, starting with a letter or digit"
            )
        for name in ("rows", "chunk_rows", "unit_rows"):
            if getattr(self, name) < 1:
                raise SessionError(
                    f"{self.name}.{name}: found {getattr(self, name)}, expected at least 1"
                )
        if self.unit_rows % self.chunk_rows:
            raise SessionError(
                f"{self.name}.unit_rows: found {self.unit_rows}, expected a multiple of "
                f"chunk_rows {self.chunk_rows}"
            )
        found = self.references
        most = np.iinfo(np.int16).max
        due = self.representation.shape
        if found.dtype != np.uint8 or found.shape[1:] != due or found.ndim != 1 + len(due):
            raise SessionError(
                f"{self.name}.references: found {found.dtype} {found.shape}, expected uint8 "
                f"(K, {', '.join(map(str, due))})"
            )
        if self.representation != MASKS and (
            self.marker_count is not None or self.lattice is not None
        ):
            raise SessionError(
                f"{self.name}: found {self.representation.name} with a marker count or a lattice; "
                "allowed: only with masks"
            )
        if not 1 <= len(found) <= most:
            raise SessionError(
                f"{self.name}.references: found {len(found)}, expected 1 to {most} of them"
            )
        if not 0 < self.mm_per_px < np.inf:
            raise SessionError(
                f"{self.name}.mm_per_px: found {self.mm_per_px}, expected more than 0"
            )
        if self.lattice is not None and self.displacement_of is not None:
            raise SessionError(
                f"{self.name}.displacement_of: found {self.displacement_of!r} together with a "
                "lattice; allowed: one of them"
            )
        _refuse_own(self.name, self.attrs, _SENSOR_KEYS)

    def create(self, path: Path) -> None:
        """Write the group of the sensor, without any frames."""
        path.mkdir()
        own = {
            "mm_per_px": float(self.mm_per_px),
            "marker_check": None if self.marker_count is None else asdict(self.marker_count),
            "displacement_of": self.displacement_of,
        }
        frame, lattice = self.representation, self.lattice
        if frame != MASKS:
            own["representation"] = frame.name
        write_group(path, {**self.attrs, **own})
        chunks = self.chunk_rows, self.unit_rows // self.chunk_rows
        ArchiveArray(
            path / "references",
            "uint8",
            self.references.shape,
            ("reference", *frame.dims),
            "1",
            frame.reference,
            1,
            len(self.references),
        ).write_whole(self.references)
        ArchiveArray(
            path / frame.array,
            "uint8",
            (self.rows, *frame.shape),
            ("row", *frame.dims),
            "1",
            frame.description,
            *chunks,
        ).create()
        if lattice is not None:
            ArchiveArray(
                path / "displacement",
                "float16",
                (self.rows, *lattice.shape),
                ("row", "lattice_row", "lattice_column", "component"),
                "px",
                "what is seen at pixel p of the untouched image is seen at p + d(p); components "
                "column, row; NaN where there is no material",
                *chunks,
                attrs={"step_px": lattice.step_px, "margin_px": lattice.margin_px},
            ).create()
        (path / frame.array / LEDGER).mkdir()


@dataclass(frozen=True, slots=True, eq=False)
class ArchivePlan:
    """Plan of a whole archive. Has no times or random values, so that two runs of it are equal."""

    sensors: tuple[SensorPlan, ...]
    """Sensors, with different names."""
    indenters: tuple[str, ...]
    """Names of the indenters, by code; the same codes in all sensors."""
    attrs: Mapping[str, Any] = field(default_factory=dict)
    """Further JSON-compatible attributes."""

    def __post_init__(self) -> None:
        """Reject plans that the format cannot hold."""
        for what, names in (
            ("sensors", [sensor.name for sensor in self.sensors]),
            ("indenters", list(self.indenters)),
        ):
            if not names or len(set(names)) != len(names):
                raise SessionError(f"{what}: found {names}, expected names that differ")
        keeping = {one.name: one.rows for one in self.sensors if one.lattice is not None}
        for one in self.sensors:
            if one.displacement_of is not None and keeping.get(one.displacement_of) != one.rows:
                raise SessionError(
                    f"{one.name}.displacement_of: found {one.displacement_of!r}; allowed: a sensor "
                    f"of {one.rows} rows with a lattice"
                )
        _refuse_own("archive", self.attrs, _ARCHIVE_KEYS)


def begin(path: Path, plan: ArchivePlan) -> None:
    """Create the archive of a plan, or check that the existing one at `path` has the same plan.

    A new archive is created atomically, with status `writing`, by one process at a time.
    """
    building = path.with_name(path.name + _CREATING)
    shutil.rmtree(building, ignore_errors=True)
    try:
        _build(building, plan)
        if path.exists():
            _require_same(building, path)
        else:
            for folder in (building, *(e for e in building.rglob("*") if e.is_dir())):
                sync_directory(folder)
            building.rename(path)
            sync_directory(path.parent)
    finally:
        # This name no longer exists after the rename.
        shutil.rmtree(building, ignore_errors=True)


def _build(path: Path, plan: ArchivePlan) -> None:
    path.mkdir(parents=True)
    own = {
        "format": ARCHIVE_FORMAT,
        "format_version": FORMAT_VERSION,
        "status": WRITING,
        "sensors": [sensor.name for sensor in plan.sensors],
        "indenters": list(plan.indenters),
    }
    write_group(path, {**plan.attrs, **own})
    for sensor in plan.sensors:
        sensor.create(path / sensor.name)


def _require_same(planned: Path, there: Path) -> None:
    for file in sorted(entry for entry in planned.rglob("*") if entry.is_file()):
        name = file.relative_to(planned)
        other = there / name
        if not other.is_file():
            raise SessionError(f"{there}: is not the archive that was planned: has no {name}")
        if file.name == "zarr.json":
            different = _differing(_without_status(file), _without_status(other))
        else:
            different = [] if file.read_bytes() == other.read_bytes() else ["the content"]
        if different:
            raise SessionError(
                f"{there}: is not the archive that was planned: {name} differs in "
                f"{', '.join(different)}; choose another path, or remove it"
            )


def _without_status(path: Path) -> dict[str, Any]:
    document = read_document(LOCAL, path)
    attributes = document.pop("attributes", {})
    return {**document, **{key: attributes[key] for key in attributes if key != "status"}}


def _differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    lacking = object()
    keys = sorted(one.keys() | other.keys())
    return [key for key in keys if one.get(key, lacking) != other.get(key, lacking)]


def _refuse_own(where: str, attrs: Mapping[str, Any], own: tuple[str, ...]) -> None:
    taken = sorted(set(attrs) & set(own))
    if taken:
        raise SessionError(f"{where}.attrs: found {', '.join(taken)}, which the format sets itself")


def read_archive_attrs(path: Path, files: Files = LOCAL) -> dict[str, Any]:
    """Return the attributes of an archive."""
    attrs = read_attrs(path, files, what="archive", format_=ARCHIVE_FORMAT, version=FORMAT_VERSION)
    for key, kind in (("status", str), ("sensors", list), ("indenters", list)):
        if not isinstance(attrs.get(key), kind):
            raise SessionError(
                f"{files.name(path)}: found attrs {key} {attrs.get(key)!r}, expected a "
                f"{kind.__name__}"
            )
    for name in attrs["sensors"]:
        require_plain_name(name)
    return attrs


def require_plain_name(name: object) -> str:
    """Return the name of a sensor after checking that it does not lead out of the archive."""
    if not isinstance(name, str) or Path(name).name != name:
        raise SessionError(f"found sensor {name!r}, expected a plain name")
    return name


def read_whole(archive: Path, files: Files, group: str, name: str) -> NDArray[Any]:
    """Return an array that is written last, from a group of the archive such as `SENSOR/table`."""
    if read_archive_attrs(archive, files)["status"] != COMPLETE:
        raise SessionError(
            f"{group}/{name}: exists only once all units are written; the archive is still being "
            "written"
        )
    return ColumnReader(ArchiveArray.load(archive / group / name, files)).read()
