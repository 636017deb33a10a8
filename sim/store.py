"""Storage of results: one Zarr v3 directory of arrays with units, for any Zarr reader.

Layout: the root group has one group per result, `0`, `1`, ...; each has the arrays of `ARRAYS` and
a group `quality`, and in its attributes the tier, the scene (`sim.result`) and the record of the
run.
"""

import os
import shutil
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from sim.result import Quality, Result, from_json, to_json
from sim.scene import Scene

FORMAT = "tactile-rig simulation"
VERSION = 1

XYZ = "component"
# Unit, dimension names and meaning of each array; `time` and `tip` repeat the scene's motion.
ARRAYS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "time": ("s", ("frame",), "when the tip is at each waypoint"),
    "tip": ("m", ("frame", XYZ), "the indenter's lowest point, contact frame"),
    "wrench": (
        "N, N, N, N m, N m, N m",
        ("frame", XYZ),
        "force and torque of the indenter on the body; pressing is negative Fz, torque about the "
        "tip",
    ),
    "surface_x": ("m", ("x",), "material points of the untouched top along x"),
    "surface_y": ("m", ("y",), "material points of the untouched top along y"),
    "surface": ("m", ("frame", "x", "y", XYZ), "displacement of those points"),
    "traction": (
        "Pa",
        ("frame", "x", "y", XYZ),
        "traction of the indenter on those points, per untouched area",
    ),
}


def save_results(path: Path, results: Sequence[Result]) -> None:
    """Write results to a new directory, atomically: under another name, renamed at the end."""
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path}: exists; allowed: a new path")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        attributes: dict[str, Any] = {"format": FORMAT, "version": VERSION, "results": len(results)}
        root = zarr.open_group(partial, mode="w-", zarr_format=3, attributes=attributes)
        for index, result in enumerate(results):
            _write(root, str(index), result)
        os.rename(partial, path)
    finally:
        # After the rename this name does not exist.
        shutil.rmtree(partial, ignore_errors=True)


def load_result(path: Path, index: int = 0) -> Result:
    """Return one result of a directory that `save_results` wrote."""
    root = zarr.open_group(Path(path), mode="r", zarr_format=3)
    version = (root.attrs.get("format"), root.attrs.get("version"))
    if version != (FORMAT, VERSION):
        raise ValueError(f"{path}: format {version!r}; allowed: {(FORMAT, VERSION)!r}")
    count: Any = root.attrs["results"]
    if not 0 <= index < count:
        raise IndexError(f"{path}: result {index}; allowed: 0 to {count - 1}")
    attributes: dict[str, Any] = root[str(index)].attrs.asdict()

    def read(name: str) -> Any:
        return np.asarray(root[f"{index}/{name}"])

    arrays = {name: read(name) for name in ARRAYS if name not in ("time", "tip")}
    return Result(
        scene=from_json(Scene, attributes["scene"], "scene"),
        tier=attributes["tier"],
        quality=Quality(**{one.name: read(f"quality/{one.name}") for one in fields(Quality)}),
        record=attributes["record"],
        **arrays,
    )


# Entries of `Quality` in metres; the others have no unit.
LENGTHS = ("overlap", "overlap_bound", "overlap_path", "contact_width")


def _write(root: zarr.Group, name: str, result: Result) -> None:
    group = root.create_group(
        name,
        attributes={"tier": result.tier, "scene": to_json(result.scene), "record": result.record},
    )
    motion = result.scene.motion
    of_motion = {"time": np.array(motion.time, float), "tip": np.array(motion.tip, float)}
    for array, (unit, dimensions, meaning) in ARRAYS.items():
        values = of_motion[array] if array in of_motion else getattr(result, array)
        _array(group, array, values, unit, dimensions, meaning)
    quality = group.create_group("quality")
    for one in fields(Quality):
        unit = "m" if one.name in LENGTHS else "1"
        _array(quality, one.name, getattr(result.quality, one.name), unit, ("frame",), "")


def _array(
    group: zarr.Group,
    name: str,
    values: np.ndarray[Any, Any],
    unit: str,
    dimensions: tuple[str, ...],
    meaning: str,
) -> None:
    # One frame per chunk: a reader of one press does not read the others.
    chunks = (1, *values.shape[1:]) if values.ndim == 4 else values.shape
    array = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype,
        chunks=chunks,
        compressors=ZstdCodec(level=3, checksum=True),
        dimension_names=dimensions,
        attributes={"units": unit, "description": meaning},
    )
    array[...] = values
