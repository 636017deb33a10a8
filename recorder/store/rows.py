"""Packing of a row into the bytes of its journal record, with validation."""

import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.store.layout import Layout, StreamLayout

_STRUCT_CODES = {
    "uint8": "<B",
    "uint16": "<H",
    "int8": "<b",
    "int16": "<h",
    "int32": "<i",
    "int64": "<q",
    "float32": "<f",
    "float64": "<d",
}

Packer = Callable[[Any], bytes]


class RowPacker:
    """Packer for the small columns of one row, in the stream's order."""

    def __init__(self, layout: StreamLayout) -> None:
        """Prepare one packer per column."""
        self._stream = layout.name
        self._names = tuple(column.column.name for column in layout.columns)
        self._packers = tuple(
            (column.column.name, _packer(column, f"{layout.name}.{column.column.name}"))
            for column in layout.small
        )

    def pack(self, columns: Mapping[str, Any]) -> bytes:
        """Return the packed row."""
        if len(columns) != len(self._names) or self._names[0] not in columns:
            raise self._wrong_names(columns)
        try:
            return b"".join([pack(columns[name]) for name, pack in self._packers])
        except KeyError:
            raise self._wrong_names(columns) from None

    def _wrong_names(self, columns: Mapping[str, Any]) -> SessionError:
        found, expected = ", ".join(columns), ", ".join(self._names)
        return SessionError(f"{self._stream}: found columns {found}; expected {expected}")


def _packer(layout: Layout, where: str) -> Packer:
    return _array_packer(layout, where) if layout.column.shape else _scalar_packer(layout, where)


def _scalar_packer(layout: Layout, where: str) -> Packer:
    dtype = layout.column.dtype
    pack = struct.Struct(_STRUCT_CODES[dtype]).pack
    exact, kinds = (float, (int, float)) if dtype.startswith("float") else (int, (int,))
    numpy_kinds = (np.integer, np.floating) if exact is float else (np.integer,)

    def pack_scalar(value: Any) -> bytes:
        if type(value) is not exact:
            if isinstance(value, np.ndarray) and value.shape == ():
                value = value[()]
            if isinstance(value, bool) or not isinstance(value, (*kinds, *numpy_kinds)):
                raise SessionError(f"{where}: found {_describe(value)}, expected {dtype}")
        try:
            return pack(value)
        except (struct.error, OverflowError):
            raise SessionError(f"{where}: found {value}, out of range for {dtype}") from None

    return pack_scalar


def _array_packer(layout: Layout, where: str) -> Packer:
    dtype, shape = layout.dtype, layout.column.shape
    expected = f"{layout.column.dtype} {shape}"

    def pack_array(value: Any) -> bytes:
        if type(value) is np.ndarray and value.dtype == dtype and value.shape == shape:
            return value.tobytes()
        try:
            array = np.asarray(value)
        except ValueError:
            raise SessionError(f"{where}: found a ragged list, expected {expected}") from None
        if array.shape != shape or not _fits(array, dtype):
            raise SessionError(f"{where}: found {_describe(array)}, expected {expected}")
        return array.astype(dtype).tobytes()

    return pack_array


def _fits(array: np.ndarray[Any, Any], dtype: np.dtype[Any]) -> bool:
    """Return True if every value survives the conversion, up to floating-point rounding."""
    if array.dtype.kind not in ("iuf" if dtype.kind == "f" else "iu"):
        return False
    if dtype.kind == "f" or not array.size:
        return True
    limits = np.iinfo(dtype)
    return bool(limits.min <= int(array.min()) and int(array.max()) <= limits.max)


def _describe(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return f"{type(value).__name__} {value!r:.40}"
