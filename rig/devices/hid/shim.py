"""Builds the library that emulates hidraw nodes, to be preloaded on a machine without hidraw.

    export LD_PRELOAD=$(python -m rig.devices.hid.shim)

It emulates the kernel's hidraw and udev for hidapi, and so does not test them; hidapi and all of
our code run as in the lab. Needs a C compiler and Linux.
"""

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
    """Compile the library into `folder` and return its path."""
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
    """Build the library once in the folder for temporary files and print its path."""
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
