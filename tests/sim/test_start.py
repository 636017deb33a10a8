"""A command that prints its result starts without the store of sessions."""

from __future__ import annotations

import subprocess
import sys


def test_a_press_that_is_only_printed_imports_no_zarr() -> None:
    program = (
        "import sys; from sim.__main__ import main; main(['press', '--tier', 'layer', '--json']); "
        "print({'zarr', 'rich', 'recorder.session'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stdout.endswith(b"set()\n")
