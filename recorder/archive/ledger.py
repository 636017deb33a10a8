"""Record of the finished units of a sensor, with their table rows until all units are finished.

There is one file per unit, `<sensor>/<array>/ledger/<unit>.npz`, written after the unit's data: a
unit without an entry does not count. It is inside the array of the frames because Zarr readers do
not list that.
"""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.archive.array import Array, own_temporary
from recorder.archive.table import SOURCE
from recorder.errors import SessionError
from recorder.store.durable import replace_file

_LINES = "source_lines"
_SUFFIX = ".npz"


@dataclass(frozen=True, slots=True)
class UnitEntry:
    """Rows of one unit."""

    columns: Mapping[str, Array]
    """Columns of the table; `source` indexes `lines`."""
    lines: tuple[str, ...]
    """Provenance lines of the unit."""


class Ledger:
    """Ledger of one sensor."""

    def __init__(self, frames: Path) -> None:
        """Set the path of the ledger in the array of the frames; nothing is read."""
        self.path = frames / "ledger"

    def create(self) -> None:
        """Create the empty ledger."""
        self.path.mkdir()

    def done(self) -> set[int]:
        """Return the numbers of the finished units; none once the archive is complete."""
        if not self.path.is_dir():
            return set()
        stems = {entry.stem for entry in self.path.iterdir() if entry.suffix == _SUFFIX}
        return {int(stem) for stem in stems if stem.isdecimal()}

    def has(self, unit: int) -> bool:
        """Return True if a unit is finished."""
        return self._entry(unit).exists()

    def enter(self, unit: int, columns: Mapping[str, Array], lines: Sequence[str]) -> None:
        """Record a unit as finished, durably.

        Args:
            unit: Number of the unit.
            columns: Its rows of the table, without `source`.
            lines: One provenance line per row.
        """
        different = tuple(dict.fromkeys(lines))
        numbers = {line: number for number, line in enumerate(different)}
        source = np.array([numbers[line] for line in lines], "<i4")
        data = io.BytesIO()
        text = np.frombuffer("\n".join(different).encode(), np.uint8)
        arrays: dict[str, Any] = {**columns, SOURCE: source, _LINES: text}
        np.savez(data, **arrays)
        path = self._entry(unit)
        replace_file(path, data.getvalue(), temporary=own_temporary(path))

    def read(self, unit: int) -> UnitEntry:
        """Return the rows of a unit."""
        path = self._entry(unit)
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
                columns = {name: stored[name] for name in stored.files}
            lines = columns.pop(_LINES).tobytes().decode().split("\n")
        except (zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
            raise SessionError(
                f"{path}: damaged ({error}); remove it and write its unit again"
            ) from error
        return UnitEntry(columns, tuple(lines))

    def remove(self) -> None:
        """Remove all entries, once the table contains them. May be called twice."""
        shutil.rmtree(self.path, ignore_errors=True)

    def _entry(self, unit: int) -> Path:
        return self.path / f"{unit}{_SUFFIX}"
