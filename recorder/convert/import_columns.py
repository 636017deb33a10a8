"""Tables as tracks: columns are known by a header, or by a mapping (`--columns FILE`).

A mapping says where each quantity is, in which unit and with which sign: in a column of a text, or
in an array of an HDF5, NPZ or NPY file. docs/how-to/foreign-tables.md has examples.
"""

import csv
import json
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from fnmatch import fnmatch, fnmatchcase
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np

from recorder.convert import import_numbers, import_tracks, import_video
from recorder.convert.import_numbers import POSE_AXES, parse_unit
from recorder.convert.import_tracks import Answers, As, Film, RecordedTrack, Times, row_times
from recorder.errors import SessionError
from recorder.settings import Reader
from recorder.spec import AXES

_NUMPY, _HDF5 = (".npy", ".npz"), (".h5", ".hdf5")
_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", *_NUMPY, *_HDF5)
_QUATERNION = ("QX", "QY", "QZ", "QW")
# Quantities of columns, with nanoseconds or SI per unit; of pictures, steps through the channels.
UNITS: dict[str, dict[str, float]] = {
    "time": {**import_numbers.TIME_UNITS, "unix": 1e9, "iso": 1e9},
    **dict.fromkeys(AXES[:3], import_tracks.FORCE_UNITS),
    **dict.fromkeys(AXES[3:], import_tracks.TORQUE_UNITS),
    **dict.fromkeys(POSE_AXES[:3], import_numbers.LENGTH_UNITS),
    **dict.fromkeys(POSE_AXES[3:], import_numbers.ANGLE_UNITS),
    "width": import_numbers.LENGTH_UNITS,
    "image": {"": 0, "rgb": 1, "bgr": -1},
    **{each: {"": 1.0} for each in (*_QUATERNION, "taxels", "values")},
}
_KINDS: dict[As, Sequence[str]] = {"video": ["image"], "taxels": ["taxels"], "force": AXES}
_KINDS |= {"pose": [*POSE_AXES, *_QUATERNION], "width": ["width"], "values": ["values"]}
# Quantities of several columns; clock of times since 1970, which several files may have.
_SEVERAL, _UTC = ("taxels", "values"), "UTC"
# Most characters of a line, and lines, of a text.
_LINE_MAX, _LINES_MAX = 1 << 17, 1 << 25
# Bits of a channel by the type of an array, and bytes of pictures that are read at once.
_BITS, _BLOCK = {"u1": 8, "u2": 16, "f4": 32, "f8": 32}, 1 << 26


@dataclass(frozen=True, slots=True)
class Column:
    """Where a quantity is: in which columns of a text, or in which array and number of its rows."""

    name: str | int | tuple[str, ...] = ""
    index: int | None = None
    unit: str = ""
    sign: Literal[1, -1] = 1


@dataclass(frozen=True, slots=True)
class Table:
    """Layout of a text, and the column of each quantity; without columns, they are by header."""

    columns: dict[str, Column] = field(default_factory=dict)
    files: str = ""
    separator: str = ","
    decimal: Literal[".", ","] = "."
    skip: int = 0
    header: bool = True
    encoding: str = "utf-8"

    def __post_init__(self) -> None:
        if len(self.separator) != 1 or self.separator in (self.decimal, '"', "\r", "\n"):
            raise ValueError(
                f"separator: found {self.separator!r} with decimal {self.decimal!r}; allowed: one "
                "other character, such as ; or a tab"
            )


def tables_of(path: Path, mappings: Iterable[tuple[str, Any]]) -> list[Table]:
    """Return the mappings, by name and content, that are for a file."""
    tables = [Reader(SessionError).build(Table, content, name) for name, content in mappings]
    fits = path.suffix.lower() in _SUFFIXES
    return [each for each in tables if (fnmatch(path.name, each.files) if each.files else fits)]


# The header of a CSV file: names of columns and their units are parsed strictly, without guessing.

_COLUMN = re.compile(
    r"^(?P<name>[A-Za-z]+)(?:\s*[(\[]\s*(?P<unit>[^)\]]+?)\s*[)\]]|_(?P<tail>\w+))?$"
)
_TIMES = ("t", "time", "timestamp")
_WORDS = {each.lower(): each for each in (*AXES, *POSE_AXES, "width")} | {"opening": "width"}
_WORDS |= dict.fromkeys(_TIMES, "time")
# Answers that have the unit of columns without one.
_ANSWERS = dict.fromkeys(AXES[:3], "units") | dict.fromkeys(AXES[3:], "torque_units")


def parse_header(names: Sequence[str], answers: Answers, where: str) -> dict[str, Column]:
    """Return the columns named as `Fx (N)`, by quantity."""
    columns: dict[str, Column] = {}
    for name in names:
        if name in answers.ignore:
            continue
        at, match = f"{where}: column {name!r}", _COLUMN.match(name)
        quantity = _WORDS.get(match["name"].lower()) if match else None
        if match is None or quantity is None:
            separator = next((each for each in ";\t" if each in "".join(names)), ",")
            words = ",".join(names).split(separator)[:200]
            quoted = [json.dumps(each, ensure_ascii=False) for each in words]
            raise SessionError(
                f"{at}: not known; allowed: {', '.join(AXES)}, each with its unit, as Fx (N), and "
                f"{', '.join(_TIMES)} with theirs; leave others out with --ignore NAME, or say "
                f"--columns FILE with such a file, QUANTITY one of {', '.join(UNITS)}:\n"
                f"separator: {json.dumps(separator)}\ncolumns:\n  QUANTITY: {{name: {quoted[0]}, "
                f"unit: UNIT, sign: 1}}  # others: {', '.join(quoted[1:])}"
            )
        option, units = _ANSWERS.get(quantity, ""), UNITS[quantity]
        unit = match["unit"] or match["tail"] or (getattr(answers, option) if option else None)
        if unit is None:
            cure = import_tracks.option_flag(option) if option else f"it as in {name} (ms)"
            raise SessionError(f"{at}: says no unit; say {cure} ({', '.join(units)})")
        parse_unit(unit, units, at)
        if quantity in columns:
            raise SessionError(f"{where}: column {quantity} comes twice")
        columns[quantity] = Column(name, unit=unit)
    if not columns.keys() - {"time"}:
        raise SessionError(f"{where}: no force column; known: {', '.join(AXES)}")
    return columns


def read_table(
    path: Path, table: Table, stream: str, films: Sequence[RecordedTrack], answers: Answers
) -> Iterator[RecordedTrack]:
    """Yield the tracks of a table, with times of any origin, which `from_start` takes out."""
    name, is_array = path.name, path.suffix.lower() in (*_NUMPY, *_HDF5)
    first, rows, table = (_arrays if is_array else _text)(path, table, answers)
    kinds = [kind for kind, quantities in _KINDS.items() if rows.keys() & {*quantities}]
    pose = [each for each in _KINDS["pose"] if each in rows]
    whole = pose in ([], [*POSE_AXES], [*POSE_AXES[:3], *_QUATERNION])
    if not (kinds and whole and rows.keys() <= UNITS.keys()):
        raise SessionError(
            f"{name}: columns: found {', '.join(rows)}; allowed: {', '.join(UNITS)}; a pose is X, "
            "Y, Z with RX, RY, RZ (rotation vector) or with QX, QY, QZ, QW"
        )
    total, factors = len(next(iter(rows.values()))), {}
    for each, column in table.columns.items():
        unit = parse_unit(column.unit, UNITS[each], f"{name}: columns.{each}.unit")
        factors[each] = column.sign * unit
        if each != "image":
            import_numbers.require_finite(rows[each].reshape(total, -1), name, first)
    if "time" not in rows:
        t_ns, clock, assumed = row_times(name, total, kinds[0], stream, films, answers)
    elif answers.rate(kinds[0], stream) is not None:
        flag = import_tracks.option_flag(import_tracks.rate_option(kinds[0]))
        raise SessionError(f"{name}: has a time column; {flag} does not go with it")
    else:
        where = f"{name}: {'row' if is_array else 'line'}"
        times, clock, assumed = rows.pop("time")[:, 0], name, []
        if table.columns["time"].unit in ("unix", "iso"):
            clock = _UTC
            if not 9e8 < times[0] < 5e9:
                raise SessionError(f"{where} {first}: found {times[0]:.16g} s since 1970")
        t_ns = import_tracks.whole_ns((times - times[0]) * factors["time"], where, first)
        t_ns += round(float(times[0]) * factors["time"])
    stated = replace(answers, units="N", torque_units="N m", width_unit="m")
    for kind in kinds:
        if kind == "video":
            content: Any = _film(name, rows["image"], int(factors["image"]), t_ns, answers)
        else:
            nothing = dict.fromkeys(AXES if kind == "force" else (), np.full((total, 1), np.nan))
            scaled = {each: rows[each] * factors[each] for each in _KINDS[kind] if each in rows}
            value = np.hstack([*(nothing | scaled).values()])
            content = import_numbers.numbers_of(name, value, t_ns, kind, stated)
        content.assumed[:0] = assumed
        yield RecordedTrack(stream if kind == kinds[0] else "", kind, content, name, clock)


def from_start(tracks: Sequence[RecordedTrack]) -> Iterator[RecordedTrack]:
    """Yield tracks of tables with times since the first row of all that have their clock."""
    for track in tracks:
        same = [each for each in tracks if track.clock == each.clock in (each.source, _UTC)]
        start = min((int(each.content.t_ns[0]) for each in same), default=0)
        yield replace(track, content=replace(track.content, t_ns=track.content.t_ns - start))


def _lines(path: Path, table: Table) -> Iterator[str]:
    """Yield the lines of a text from the header on, each of a size that a row may have."""
    try:
        with path.open(newline="", encoding=table.encoding) as file:
            for number, line in enumerate(iter(partial(file.readline, _LINE_MAX), ""), 1):
                if len(line) == _LINE_MAX or "\0" in line or number > _LINES_MAX:
                    raise UnicodeError(f"line {number}: too long, or not {table.encoding}")
                if number > table.skip:
                    yield line.rstrip(" \r\n")
    except (UnicodeError, LookupError) as error:
        raise SessionError(f"{path.name}: {error}; --columns FILE has a key encoding") from None


def _text(path: Path, table: Table, answers: Answers) -> tuple[int, dict[str, Any], Table]:
    """Return the line of the first row, quantities (n, k) or files (n,), and their mapping."""
    name, lines = path.name, _lines(path, table)
    rows: Iterator[list[str]] = csv.reader(lines, delimiter=table.separator, skipinitialspace=True)
    top = next(rows, [])
    names = [word.strip().strip("'\"# \ufeff") for word in top]
    if not table.columns and len(names) == 48:
        header = re.fullmatch(r"[-+.\deE\s]+", names[0]) is None
        table = replace(table, columns={"taxels": Column("*")}, header=header)
    elif not table.columns:
        table = replace(table, columns=parse_header(names, answers, name))
    if not table.header:
        names, rows = [str(at) for at in range(len(top))], chain([top], rows)
    cells: dict[str, Any] = {each: [] if each == "image" else array("d") for each in table.columns}
    readers = [(cells[each].append, *others) for each, *others in _readers(path, table, names)]
    first = line = table.skip + table.header + 1
    for words in rows:
        if not words and not any(rows):
            break  # Blank lines may end a table.
        if len(words) != len(names):
            counts = f"found {len(words)} values, the header has {len(names)}"
            raise SessionError(f"{name}: line {line}: {counts}; is the file cut short?")
        for append, at, read, expected in readers:
            try:
                append(read(words[at]))
            except ValueError:
                found = f"line {line}: {names[at]}: found {words[at]!r}"
                raise SessionError(f"{name}: {found}, expected {expected}") from None
        line += 1
    if line == first:
        raise SessionError(f"{name}: found {line - 1} lines; expected a header and rows")
    for quantity in cells.keys() - {"image"}:
        cells[quantity] = np.asarray(cells[quantity]).reshape(line - first, -1)
    return first, cells, table


def _readers(path: Path, table: Table, names: Sequence[str]) -> Iterator[tuple[str, int, Any, str]]:
    """Yield quantity, number of its column, the reader of a word in it and its expectation."""
    swapped = str.maketrans(",.", ".,")
    for quantity, column in table.columns.items():
        places = [
            at
            for each in (column.name if isinstance(column.name, tuple) else [str(column.name)])
            for at, other in enumerate(names)
            if other == each or fnmatchcase(other, each)
        ]
        several = len(places) > 1 and quantity not in _SEVERAL
        if not places or several or column.index is not None:
            raise SessionError(
                f"{path.name}: columns.{quantity}: found {len(places)} columns {column.name!r}, "
                f"index {column.index}; allowed: one by its name, of {', '.join(names[:200])}"
            )
        read: Any = float
        expected = f"a number with decimal {table.decimal!r}"
        if table.decimal == ",":
            read = lambda word: float(word.translate(swapped))  # noqa: E731
        if column.unit == "iso":
            read, expected = _seconds, "an ISO 8601 stamp"
        elif quantity == "image":
            read = partial(_file, path.parent, path.parent.resolve())
            expected = "a file in the folder of the table"
        yield from ((quantity, at, read, expected) for at in places)


def _seconds(stamp: str) -> float:
    """Return an ISO 8601 stamp as seconds since 1970; one without a zone is in UTC."""
    moment = datetime.fromisoformat(stamp.strip())
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _file(folder: Path, root: Path, name: str) -> Path:
    """Return the file of a name in a folder or below it; `root` is what the folder resolves to."""
    file = folder / name.strip().replace("\\", "/")
    if not file.resolve().is_relative_to(root) or not file.is_file():
        raise ValueError(name)
    return file


def _arrays(path: Path, table: Table, _: Answers) -> tuple[int, dict[str, Any], Table]:
    """Return the first row, quantities (n, ...) in the arrays of a file, and their mapping."""
    inner = {each: str(column.name) for each, column in table.columns.items()}
    in_numpy = path.suffix.lower() in _NUMPY
    loaded = import_numbers.load_arrays(path, inner.values()) if in_numpy else {}
    content: dict[str, Any] = {}
    for quantity, column in table.columns.items():
        source = f"{path.name}:{inner[quantity]}".removesuffix(":")
        data = loaded[source] if in_numpy else _data_set(path, inner[quantity])
        import_numbers.require_size(path, data.nbytes)
        if quantity != "image" or column.index is not None:
            rows = np.array(data, np.float64).reshape(len(data), -1)
            several = quantity in _SEVERAL and column.index is None
            if column.index is not None:
                rows = rows[:, column.index : column.index + 1]
            if rows.shape[1] != 1 and not several:
                raise SessionError(
                    f"{source}: columns.{quantity}.index: found {column.index}; allowed: a number "
                    f"within rows of shape {data.shape[1:]}"
                )
            data = rows.reshape(data.shape) if several else rows
        content[quantity] = data
    lengths = {inner[each]: len(content[each]) for each in content}
    if len({*lengths.values()}) > 1:
        raise SessionError(f"{path.name}: found {lengths} rows; map each number in its own FILE")
    return 0, content, table


def _data_set(path: Path, name: str) -> Any:
    """Return an array that an HDF5 file itself holds, behind no link; it stays open."""
    import h5py

    file = data = h5py.File(path, "r")
    for part in name.strip("/").split("/"):
        link = data.get(part, getlink=True) if isinstance(data, h5py.Group) else None
        data = data[part] if isinstance(link, h5py.HardLink) else None
    own = isinstance(data, h5py.Dataset) and not (data.external or data.is_virtual)
    if not own or data.dtype.kind not in "iuf" or not data.shape or not len(data):
        names: list[str] = []
        file.visit(names.append)
        raise SessionError(f"{path.name}: found {name!r}; allowed: its own arrays, of {names[:99]}")
    return data


def _film(name: str, pictures: Any, step: int, t_ns: Times, answers: Answers) -> Film:
    """Return files (n,), or an array (n, h, w) or (n, h, w, 3), as pictures at times (n,) [ns].

    `step` is that through the channels: -1 for blue, green and red; 0: not stated.
    """
    names, times = [str(row) for row in range(len(pictures))], "pictures of its rows"
    if isinstance(pictures, list):
        if step < 0:
            raise SessionError(f"{name}: columns.image.unit: found bgr; allowed for files: rgb")
        names = [each.name for each in pictures]
        film = import_video.film_of_files(name, [*zip(names, pictures, strict=True)], t_ns, times)
        return replace(film, names=names if answers.stills else [])
    height, width, *channels = pictures.shape[1:] if pictures.ndim > 2 else (0, 0)
    bits = _BITS.get(pictures.dtype.str[1:])
    if not bits or not height or channels not in ([], [3]) or (channels and not step):
        raise SessionError(
            f"{name}: columns.image: found shape {pictures.shape} of {pictures.dtype}; allowed: "
            f"(n, h, w), or (n, h, w, 3) with unit rgb or bgr, of {', '.join(_BITS)}"
        )
    import_video.require_pixels(name, height, width)
    order = [0, 1, 2][::step] if channels else [0, 0, 0]
    block = max(1, _BLOCK * len(pictures) // pictures.nbytes)

    def load() -> Iterator[Any]:
        for start in range(0, len(pictures), block):
            for image in pictures[start : start + block]:
                yield image.reshape(height, width, -1).take(order, axis=2)

    sizes = [(height, width, bits)]
    film = import_video.film_of_pictures(name, sizes, t_ns, load, jpeg=False, times=times)
    return replace(film, names=names if answers.stills else [])
