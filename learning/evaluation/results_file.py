"""Result files: an .npz with a JSON header and arrays, of one kind, written atomically."""

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

_HEADER = "header"
_KIND, _VERSION = "kind", "version"
_NEWEST = 1


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """Content of a file."""

    kind: str
    reported: Mapping[str, Any]
    """JSON header."""
    arrays: Mapping[str, NDArray[Any]]
    """Their arrays, by name."""


def write_results(path: Path, results: Results) -> None:
    """Write results to a temporary file and rename it, so that an older file stays until then."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {**results.reported, _KIND: results.kind, _VERSION: _NEWEST}
    text = np.frombuffer(json.dumps(header, sort_keys=True).encode(), np.uint8)
    arrays: dict[str, Any] = {_HEADER: text, **results.arrays}
    partial = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with partial.open("wb") as file:
            np.savez_compressed(file, **arrays)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_results(path: Path) -> Results:
    """Read a result file."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop(_HEADER).tobytes())
        kind, version = str(header.pop(_KIND)), int(header.pop(_VERSION))
    except FileNotFoundError:
        raise LearningError(f"{path}: there is no such file") from None
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise LearningError(
            f"{path}: found no results ({error}); allowed: what predict or evaluate wrote"
        ) from None
    if version > _NEWEST:
        raise LearningError(f"{path}: found version {version}; allowed: up to {_NEWEST}")
    return Results(kind, header, arrays)
