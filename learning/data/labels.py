"""Labels from a file, for a sensor whose recordings have none, or in their place.

The file is a CSV with the columns `indenter`, `target`, `frame` (as in the sensor's archive) and
`fx_n`, `fy_n`, `fz_n` [N]; an empty force, or a column that is not there, is not measured. Readings
that were typed in have no frame: without one, a force is that at the end of the pressing, where a
press is held.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.archive import MarkerArchive
from recorder.spec import PHASES

Floats = NDArray[np.float64]

KEYS, FORCES = ("indenter", "target"), ("fx_n", "fy_n", "fz_n")
FRAME = "frame"
_PRESSING = PHASES.index("normal_inc")


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Labels of a few frames of a sensor, in the order of their presses."""

    rows: NDArray[np.int64]
    """Rows of the sensor's table (n,)."""
    forces: Floats
    """Fx, Fy, Fz (n, 3) [N]; NaN is not measured."""
    press: NDArray[np.int64]
    """Number of the press of each, 0 and up (n,)."""

    @property
    def presses(self) -> int:
        """Number of labelled presses."""
        return int(self.press.max()) + 1

    def of_all(self, rows: int) -> Floats:
        """Return the forces of all rows of the table (rows, 3) [N]; NaN without a label."""
        forces = np.full((rows, len(FORCES)), np.nan)
        forces[self.rows] = self.forces
        return forces


def read_labels(path: Path, archive: MarkerArchive, sensor: str) -> Labels:
    """Read the labels of a sensor's frames."""
    table = archive[sensor].table
    names = archive.indenters
    row_of = {
        (names[code], int(target), int(frame)): row
        for row, (code, target, frame) in enumerate(
            zip(table["indenter"], table["target"], table["frame"], strict=True)
        )
        if table["valid"][row]
    }
    held = {
        key[:2]: key[2] for key, row in sorted(row_of.items()) if table["phase"][row] == _PRESSING
    }
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            columns = set(reader.fieldnames or ())
            if (missing := set(KEYS) - columns) or not columns & set(FORCES):
                lacking = ", ".join(sorted(missing)) or "a column of forces"
                raise LearningError(
                    f"{path}: missing {lacking}; allowed: the columns {', '.join(KEYS)}, "
                    f"{FRAME} (none: where the press is held), and some of {', '.join(FORCES)}"
                )
            lines = list(reader)
    except (OSError, UnicodeDecodeError) as error:
        raise LearningError(f"{path}: cannot be read: {error}") from None
    forces_of: dict[int, list[float]] = {}
    pressed: dict[tuple[str, int], int] = {}
    numbers: list[int] = []
    for number, line in enumerate(lines, 2):
        prefix = f"{path}, line {number}"
        try:
            press = line["indenter"], int(line["target"])
            frame = line.get(FRAME, "").strip()
            key = *press, int(frame) if frame else held.get(press, -1)
            texts = [line.get(name, "").strip() for name in FORCES]
            forces = [float(text) if text else math.nan for text in texts]
        except (TypeError, ValueError, AttributeError) as error:
            raise LearningError(f"{prefix}: {error}; allowed: numbers, or no force") from None
        if math.inf in map(abs, forces):
            raise LearningError(f"{prefix}: found an infinite force; allowed: numbers, or none")
        if key not in row_of:
            named = f"frame {frame}" if frame else "frame where it is held"
            raise LearningError(f"{prefix}: {sensor} has no {named} of target {key[1]} of {key[0]}")
        if row_of[key] in forces_of:
            raise LearningError(f"{prefix}: found frame {key} twice; allowed: once")
        forces_of[row_of[key]] = forces
        numbers.append(pressed.setdefault(press, len(pressed)))
    if not forces_of or np.isnan(list(forces_of.values())).all():
        raise LearningError(f"{path}: found no force; allowed: one or more")
    return Labels(np.array(list(forces_of)), np.array(list(forces_of.values())), np.array(numbers))
