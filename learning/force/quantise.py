"""Convolutions of an exported model in 8-bit integers, by ONNX Runtime."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from learning.errors import LearningError


def quantise(exported: Path, out: Path, inputs: Iterable[Mapping[str, Any]]) -> None:
    """Write a model whose convolutions are int8: weights by channel, activations by tensor.

    Args:
        exported: The model in float.
        out: Where the new one goes.
        inputs: Inputs of steps, by name, that show how large activations become.

    Raises:
        LearningError: The package `onnx` is not installed.
    """
    try:
        from onnxruntime import quantization
    except ImportError:
        raise LearningError("onnx: not installed; pip install onnx") from None
    reader = _reader(quantization.CalibrationDataReader, iter(inputs))
    quiet = logging.getLogger()
    level = quiet.level
    quiet.setLevel(logging.ERROR)  # it advises to run a step first that needs another package
    try:
        quantization.quantize_static(
            str(exported),
            str(out),
            reader,
            quant_format=quantization.QuantFormat.QDQ,
            per_channel=True,
            op_types_to_quantize=["Conv"],
        )
    finally:
        quiet.setLevel(level)


def _reader(base: Any, inputs: Iterator[Mapping[str, Any]]) -> Any:
    class Reader(base):  # type: ignore[misc]
        def get_next(self) -> dict[str, Any] | None:
            found = next(inputs, None)
            return None if found is None else dict(found)

    return Reader()
