"""Which units of a sensor are done, and their rows of the table until all are.

One file a unit, `<sensor>/markers/ledger/<unit>.npz`, written after the unit's data: a unit without
its entry does not count. The directory of an array is the one place where no Zarr reader lists it.
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
    """The rows of one unit."""

    columns: Mapping[str, Array]
    """Columns of the table; `source` points into `lines`."""
    lines: tuple[str, ...]
    """Lines of provenance of the unit."""


class Ledger:
    """The ledger of one sensor."""

    def __init__(self, sensor: Path) -> None:
        """Show the ledger of the sensor's group."""
        self.path = sensor / "markers" / "ledger"

    def create(self) -> None:
        """Make room for entries."""
        self.path.mkdir()

    def done(self) -> set[int]:
        """Return the numbers of the units that are there; none once the archive is complete."""
        if not self.path.is_dir():
            return set()
        stems = {entry.stem for entry in self.path.iterdir() if entry.suffix == _SUFFIX}
        return {int(stem) for stem in stems if stem.isdecimal()}

    def has(self, unit: int) -> bool:
        """Whether a unit is there."""
        return self._entry(unit).exists()

    def enter(self, unit: int, columns: Mapping[str, Array], lines: Sequence[str]) -> None:
        """Say that a unit is there, for good.

        Args:
            unit: Its number.
            columns: Its rows of the table, without `source`.
            lines: A line of provenance for each row.

        Raises:
            FileNotFoundError: The ledger was removed, because the archive is complete.
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
        """Return the rows of a unit.

        Raises:
            SessionError: The entry is damaged.
            FileNotFoundError: There is none.
        """
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
        """Drop all entries: the table holds them now. Safe twice."""
        shutil.rmtree(self.path, ignore_errors=True)

    def _entry(self, unit: int) -> Path:
        return self.path / f"{unit}{_SUFFIX}"
