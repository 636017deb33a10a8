"""Format of an archive: its arrays, columns and attributes, and the plan that creates them.

A plan is fixed before any data is written; the same plan resumes the archive.
"""

import math
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.markers import PACKED, SMALLEST_PX, Lattice
from recorder.settings import differing_keys
from recorder.spec import ARCHIVE_FORMAT, PHASES
from recorder.store.documents import read_attrs, read_document, write_group
from recorder.store.files import CREATING, LOCAL, Files, replace_file, sync_directory
from recorder.store.layout import Array, ArrayLayout, packed_index

FORMAT_VERSION = 1
WRITING, COMPLETE = "writing", "complete"

# Folder of the finished units in the array of the frames, which Zarr readers do not list.
LEDGER = "ledger"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_ARCHIVE_KEYS = ("format", "format_version", "status", "sensors", "indenters")
_SENSOR_KEYS = ("mm_per_px", "marker_check", "displacement_of", "representation")

# Arrays of frames, by what they represent.

# Side of a shading image, and its value where nothing changed.
SHADING_SIDE, SHADING_ZERO = 128, 128


@dataclass(frozen=True, slots=True)
class Representation:
    """One row a representation: all that differs on disk."""

    name: str
    """Name, stored as the sensor's attribute `representation`; sensors without one hold masks."""
    array: str
    """Array of the frames."""
    shape: tuple[int, ...]
    """Shape of one frame, uint8."""
    dims: tuple[str, ...]
    """Dimension names of one frame."""
    description: str
    """One sentence for readers who have only the array."""
    reference: str
    """The same for `references`."""


MASKS = Representation(
    "masks",
    "markers",
    (PACKED,),
    ("byte",),
    "mask of 480 x 640 pixels, row-major, first pixel in the highest bit, 1 = marker",
    "masks of the untouched sensor, packed as markers are",
)
SHADING = Representation(
    "shading",
    "shading",
    (3, SHADING_SIDE, SHADING_SIDE),
    ("colour", "y", "x"),
    "red, green, blue minus those of the untouched sensor, plus 128, cut to 0 to 255; each pixel "
    "the mean over a cell of the camera's image",
    "red, green, blue of the untouched sensor",
)
REPRESENTATIONS: Mapping[str, Representation] = {each.name: each for each in (MASKS, SHADING)}


@dataclass(frozen=True)
class ArchiveArray(ArrayLayout):
    """One array of an archive, of fixed length.

    A shard is written in one go under a name unique to its writer, made durable and then renamed.
    """

    level: int = 3
    """Level of zstd for new chunks; any is read."""

    # All shards are in one directory: one name to make durable, not a path.
    separator = "."
    # No manifest has a checksum of an archive's metadata.
    compared = (
        *ArrayLayout.compared,
        *("zarr_format", "fill_value", "storage_transformers", "attributes"),
    )

    @property
    def shards(self) -> int:
        """Number of shards."""
        return math.ceil(self.rows() / self.rows_per_shard)

    def rows_of_shard(self, number: int) -> slice:
        """Return the rows in a shard."""
        first = number * self.rows_per_shard
        return slice(first, min(first + self.rows_per_shard, self.rows()))

    def write_shard(self, number: int, values: Array) -> None:
        """Write all rows of a shard; equal rows give equal bytes."""
        rows = self.rows_of_shard(number)
        due = (rows.stop - rows.start, *self.shape[1:])
        if values.shape != due or values.dtype != self.dtype:
            raise SessionError(
                f"{self.path}: found {values.dtype} {values.shape} for shard {number}, "
                f"expected {self.data_type} {due}"
            )
        step = self.rows_per_chunk
        chunks = [self.encoded(values[first : first + step]) for first in range(0, due[0], step)]
        ends = np.cumsum([len(chunk) for chunk in chunks]).tolist()
        entries = [(end - len(chunk), len(chunk)) for end, chunk in zip(ends, chunks, strict=True)]
        data = b"".join((*chunks, packed_index(entries, self.chunks_per_shard)))
        replace_file(self.shard(number), data, several=True)

    def write_whole(self, values: Array) -> None:
        """Write an array of one shard, replacing any existing."""
        self.create()
        self.write_shard(0, values)


# The table of a sensor: metadata of each frame, with its columns and their allowed values.

# The column that the writer fills: it indexes the provenance lines.
SOURCE = "source"
# Code of a frame that belongs to no phase.
NO_PHASE = -1

_CHUNK_ROWS, _SOURCE_CHUNK = 4096, 256


@dataclass(frozen=True, slots=True)
class ColumnKind:
    """One column of a table."""

    dtype: str
    """Zarr data type."""
    units: str
    """Units as stored."""
    description: str
    """One sentence for readers who have only the array."""
    shape: tuple[int, ...] = ()
    """Shape of one value."""
    dims: tuple[str, ...] = ()
    """Dimension names of one value."""
    least: int | None = None
    """Smallest allowed value of an integer column."""
    may_be_nan: bool = False
    """True if NaN is allowed, in all of a row's values or none."""


# Columns of a table, in order.
COLUMNS: Mapping[str, ColumnKind] = {
    "indenter": ColumnKind("int16", "1", "code of the indenter, see attrs names", least=0),
    "seen": ColumnKind("bool", "1", "whether models may be trained on the indenter"),
    "location": ColumnKind(
        "int32",
        "1",
        "equal in rows of two sensors that were pressed at the same place; -1: at none",
        least=-1,
    ),
    "target": ColumnKind("int16", "1", "number of the target within the indenter", least=0),
    "phase": ColumnKind("int8", "1", "code of the phase, see attrs names; -1: none", least=-1),
    "depth": ColumnKind("float64", "m", "commanded indentation"),
    "position": ColumnKind(
        "float64",
        "m",
        "indenter in the contact frame, x to the right and y up in the image",
        (2,),
        ("axis",),
    ),
    "wrench": ColumnKind(
        "float64",
        "N, N m",
        "Fx Fy Fz [N], Tx Ty Tz [N m]; pressing is negative Fz; NaN without a label",
        (6,),
        ("axis",),
        may_be_nan=True,
    ),
    "frame": ColumnKind("int32", "1", "number of the frame within its target", least=0),
    "t_ns": ColumnKind("int64", "ns", "time of the frame, on the clock of its source"),
    "reference": ColumnKind("int16", "1", "row of references", least=0),
    "valid": ColumnKind(
        "bool", "1", "whether there is such a frame; where not, its source says why"
    ),
    SOURCE: ColumnKind("int32", "1", "row of sources", least=0),
}

# Columns that a simulation may add to a complete archive (`write_simulated`).
SIMULATED: Mapping[str, ColumnKind] = {
    name: ColumnKind("float64", "N", description, (3,), ("axis",), may_be_nan=True)
    for name, description in (
        ("simulated", "Fx Fy Fz that a twin of the sensor gives in the frame's press; NaN: none"),
        ("simulated_spread", "standard deviation of these forces by the twin's uncertainty"),
    )
}

# Columns that the caller of the writer supplies.
GIVEN = tuple(name for name in COLUMNS if name != SOURCE)


@dataclass(frozen=True, slots=True)
class Limits:
    """Numbers of entries that codes may refer to."""

    indenters: int
    references: int
    sources: int | None = None
    """None while provenance lines are still being collected."""

    def of(self, name: str) -> int | None:
        """Return the exclusive upper limit of a column's values; None if there is none."""
        ends = {"indenter": self.indenters, "reference": self.references, SOURCE: self.sources}
        return ends.get(name, len(PHASES) if name == "phase" else None)


def checked_columns(
    table: Mapping[str, Any], rows: int, limits: Limits, where: str
) -> dict[str, Array]:
    """Return the columns of `GIVEN`, a value per row, as arrays; `where` is for messages."""
    if set(table) != set(GIVEN):
        raise SessionError(
            f"{where}: found columns {', '.join(sorted(table))}; expected {', '.join(GIVEN)}"
        )
    columns = {}
    for name in GIVEN:
        columns[name] = _typed(table[name], COLUMNS[name], rows, f"{where}.{name}")
        wrong = np.flatnonzero(misplaced(name, columns[name], limits))
        if wrong.size:
            problem = f"found {columns[name][wrong[0]]} in row {wrong[0]}"
            raise SessionError(f"{where}.{name}: {problem}; allowed: {allowed(name, limits)}")
    return columns


def misplaced(name: str, values: Array, limits: Limits) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows of a column whose values are not allowed."""
    column, wrong = COLUMNS[name], np.zeros(len(values), np.bool_)
    if values.dtype.kind == "f":
        values = values.reshape(len(values), -1)
        fine = ~np.isinf(values) if column.may_be_nan else np.isfinite(values)
        return np.asarray(wrong | ~fine.all(axis=1), np.bool_)
    end = limits.of(name)
    if column.least is not None:
        wrong |= values < column.least
    if end is not None:
        wrong |= values >= end
    return wrong


def allowed(name: str, limits: Limits) -> str:
    """Return the allowed values of a column as text."""
    column, end = COLUMNS[name], limits.of(name)
    if column.dtype.startswith("float"):
        return "finite values" + ", or NaN" * column.may_be_nan
    return f"{column.least} " + ("and more" if end is None else f"to {end - 1}")


def column_array(
    path: Path, rows: int, names: Sequence[str] = (), attrs: Mapping[str, Any] | None = None
) -> ArchiveArray:
    """Return the array of a column of `COLUMNS` or `SIMULATED`, named by its path: one file.

    `rows` is the length of the table, `names` are those of the codes, in order.
    """
    column = {**COLUMNS, **SIMULATED}[path.name]
    return ArchiveArray(
        path,
        column.dtype,
        (rows, *column.shape),
        ("row", *column.dims),
        column.units,
        column.description,
        _CHUNK_ROWS,
        -(-rows // _CHUNK_ROWS),
        ({"names": list(names)} if names else {}) | dict(attrs or {}),
    )


def write_table(
    sensor: Path,
    rows: int,
    columns: Mapping[str, Array],
    indenters: Sequence[str],
    lines: Sequence[str],
) -> None:
    """Write the table of a sensor, all columns of `COLUMNS`, and its provenance lines, durably."""
    path = sensor / "table"
    path.mkdir(exist_ok=True)
    write_group(path, {})
    names = {"indenter": indenters, "phase": PHASES}
    for name in COLUMNS:
        array = column_array(path / name, rows, names.get(name, ()))
        array.write_whole(columns[name])
    _write_sources(sensor / "sources", lines)
    for folder in (path, sensor):
        sync_directory(folder)


def _write_sources(path: Path, lines: Sequence[str]) -> None:
    encoded = [line.encode() for line in lines]
    width = max(map(len, encoded))
    text = np.zeros((len(lines), width), np.uint8)
    for row, data in zip(text, encoded, strict=True):
        row[: len(data)] = np.frombuffer(data, np.uint8)
    ArchiveArray(
        path,
        "uint8",
        text.shape,
        ("source", "byte"),
        "1",
        "where samples come from: a line of UTF-8 each, padded with zeros",
        _SOURCE_CHUNK,
        -(-len(lines) // _SOURCE_CHUNK),
    ).write_whole(text)


def _typed(values: Any, column: ColumnKind, rows: int, where: str) -> Array:
    dtype, due = np.dtype(column.dtype), (rows, *column.shape)
    array = np.asarray(values)
    actual = f"{array.dtype} {array.shape}"
    # Kinds whose values survive the conversion, up to rounding and range.
    kinds = {"b": "b", "i": "iu", "f": "iuf"}[dtype.kind]
    if array.shape != due or array.dtype.kind not in kinds:
        raise SessionError(f"{where}: found {actual}, expected {column.dtype} {due}")
    if dtype.kind == "i" and array.size:
        limits = np.iinfo(dtype)
        if int(array.min()) < limits.min or int(array.max()) > limits.max:
            raise SessionError(
                f"{where}: found values from {array.min()} to {array.max()}, out of range for "
                f"{column.dtype}"
            )
    return array.astype(dtype.newbyteorder("<"))


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

    def __post_init__(self) -> None:
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
        array = self.references
        most = np.iinfo(np.int16).max
        due = self.representation.shape
        if array.dtype != np.uint8 or array.shape[1:] != due or array.ndim != 1 + len(due):
            raise SessionError(
                f"{self.name}.references: found {array.dtype} {array.shape}, expected uint8 "
                f"(K, {', '.join(map(str, due))})"
            )
        if self.representation != MASKS and (
            self.marker_count is not None or self.lattice is not None
        ):
            raise SessionError(
                f"{self.name}: found {self.representation.name} with a marker count or a lattice; "
                "allowed: only with masks"
            )
        if not 1 <= len(array) <= most:
            raise SessionError(
                f"{self.name}.references: found {len(array)}, expected 1 to {most} of them"
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
    building = path.with_name(path.name + CREATING)
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
            different = differing_keys(_without_status(file), _without_status(other))
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


def _refuse_own(where: str, attrs: Mapping[str, Any], own: tuple[str, ...]) -> None:
    clash = sorted(set(attrs) & set(own))
    if clash:
        raise SessionError(f"{where}.attrs: found {', '.join(clash)}, which the format sets itself")


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


@dataclass(frozen=True)
class StoredSensor:
    """Stored form of a sensor, except its table: metadata of its group and arrays."""

    path: Path
    """Its group."""
    files: Files
    """File access for the group."""
    attrs: dict[str, Any]
    representation: Representation
    frames: ArchiveArray
    references: ArchiveArray
    """Array of the frames without contact."""

    @cached_property
    def displacement(self) -> ArchiveArray | None:
        """Displacement fields in the sensor's own group; None if there are none."""
        path = self.path / "displacement"
        return ArchiveArray.load(path, self.files) if path in self.files.groups(self.path) else None


def read_sensor(path: Path, files: Files = LOCAL) -> StoredSensor:
    """Return the stored form of a sensor, by its metadata."""
    attrs: dict[str, Any] = read_document(files, path / "zarr.json").get("attributes", {})
    scale = attrs.get("mm_per_px")
    if not isinstance(scale, int | float):
        raise SessionError(
            f"{files.name(path)}: found attrs mm_per_px {scale!r}, expected a number"
        )
    name = str(attrs.get("representation", MASKS.name))
    if name not in REPRESENTATIONS:
        raise SessionError(
            f"{files.name(path)}: found attrs representation {name!r:.80}, known: "
            f"{', '.join(REPRESENTATIONS)}"
        )
    frames = ArchiveArray.load(path / REPRESENTATIONS[name].array, files)
    references = ArchiveArray.load(path / "references", files)
    return StoredSensor(path, files, attrs, REPRESENTATIONS[name], frames, references)


def require_plain_name(name: object) -> str:
    """Return the name of a sensor after checking that it does not lead out of the archive."""
    if not isinstance(name, str) or Path(name).name != name or not name.isprintable():
        raise SessionError(f"found sensor {name!r}, expected a plain name")
    return name


def late_array(sensor: Path, name: str, files: Files) -> ArchiveArray:
    """Return an array of a sensor that is written last, such as `table/depth`."""
    if read_archive_attrs(sensor.parent, files)["status"] != COMPLETE:
        raise SessionError(
            f"{sensor.name}/{name}: exists only once all units are written; the archive is still "
            "being written"
        )
    return ArchiveArray.load(sensor / name, files)
