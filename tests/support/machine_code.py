"""Machine code of a compiled kernel, to check that two kernels are the same."""

import struct
from pathlib import Path
from typing import Any

import warp as wp


def machine_code(kernel: Any) -> bytes:
    """Return the instructions of a kernel in its own module, compiled for the CPU.

    They exclude names, and the addresses that the linker will fill in.

    Raises:
        FileNotFoundError: Warp kept no object file, or one that is not ELF.
    """
    wp.init()  # type: ignore[no-untyped-call]
    kernel.module.load("cpu")
    folder = Path(wp.config.kernel_cache_dir or "") / kernel.module.get_module_identifier()
    for path in sorted(folder.glob("*.o")):
        content = path.read_bytes()
        if content[:5] == b"\x7fELF\x02":
            return _text(content)
    raise FileNotFoundError(f"{folder}: no object file in 64-bit ELF")


def _text(content: bytes) -> bytes:
    """Return all executable sections of a 64-bit ELF file (System V ABI, chapter 4), in turn."""
    (table,) = struct.unpack_from("<Q", content, 40)
    size, count = struct.unpack_from("<HH", content, 58)
    executable, found = 4, b""
    for index in range(count):
        flags, _, start, length = struct.unpack_from("<QQQQ", content, table + index * size + 8)
        if flags & executable:
            found += content[start : start + length]
    return found
