"""Builds the library that gives a machine without hidraw emulated nodes, to be preloaded.

    export LD_PRELOAD=$(python -m rig.devices.hid.shim)

It is an emulator: the kernel's hidraw and udev, seen from hidapi. What it stands in for is not
tested by it; hidapi, and all of ours, runs as in the lab. Needs a C compiler and Linux.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from rig.core.errors import ConfigError

SOURCE = Path(__file__).with_name("hidraw_shim.c")


def build(folder: Path) -> Path:
    """The compiled library in `folder`.

    Raises:
        ConfigError: No compiler, not Linux, or it does not compile.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        raise ConfigError("hidraw shim: needs Linux and a C compiler; found none of gcc, cc")
    library = folder / "hidraw_shim.so"
    command = [compiler, "-O1", "-w", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode != 0:
        raise ConfigError(f"hidraw shim: does not compile here: {built.stderr.strip()[:300]}")
    return library


def main() -> int:
    """Build it once in the folder for temporary files and print where it is."""
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:12]
    folder = Path(tempfile.gettempdir()) / f"tactile-rig-hidraw-{digest}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        print(f"{folder}: belongs to somebody else", file=sys.stderr)
        return 2
    try:
        library = folder / "hidraw_shim.so"
        print(library if library.exists() else build(folder))
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
