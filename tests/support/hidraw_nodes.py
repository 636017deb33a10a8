"""Run Python with nodes that a preloaded shim provides, as that of rig.devices.hid."""

from pathlib import Path

import pytest
from support.commands import python

from rig.core.errors import ConfigError
from rig.devices.hid.shim import build


def library(folder: Path) -> Path:
    """Return the built shim; skip the test if it cannot be built."""
    try:
        return build(folder)
    except ConfigError as error:
        pytest.skip(str(error))


def run(
    shim: Path, code: str, *arguments: str, nodes: Path | None = None, **variables: object
) -> str:
    """Return the output of `code` with the shim preloaded, and `variables` of its environment."""
    environment = {name: str(value) for name, value in variables.items()}
    if nodes is not None:
        environment["FAKE_HIDRAW"] = str(nodes)
    return python("-c", code, *arguments, LD_PRELOAD=str(shim), **environment).stdout
