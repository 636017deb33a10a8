"""Run Python with nodes that a preloaded shim provides, as that of rig.devices.hid."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rig.core.errors import ConfigError
from rig.devices.hid.shim import build

ROOT = Path(__file__).parents[2]


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
    environment = os.environ | {"LD_PRELOAD": str(shim), "PYTHONPATH": str(ROOT)}
    environment |= {name: str(value) for name, value in variables.items()}
    environment.pop("FAKE_HIDRAW", None)
    if nodes is not None:
        environment["FAKE_HIDRAW"] = str(nodes)
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
