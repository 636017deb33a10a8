"""Other readers of Zarr arrays than zarr-python's own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zarr

READERS = ("tensorstore", "zarrs")


def reader_of_zarr(name: str) -> Callable[[Path], Any]:
    """Return the function that reads an array by that library; skip if it is not installed."""
    library = pytest.importorskip(name, reason=f"{name} is not installed")

    def read_by_tensorstore(path: Path) -> Any:
        spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(path)}}
        return library.open(spec).result().read().result()

    def read_by_zarrs(path: Path) -> Any:
        with zarr.config.set({"codec_pipeline.path": "zarrs.ZarrsCodecPipeline"}):
            array = zarr.open_array(path, mode="r")
            assert type(array._async_array.codec_pipeline).__module__.startswith("zarrs")
            return array[:]

    return {"tensorstore": read_by_tensorstore, "zarrs": read_by_zarrs}[name]
