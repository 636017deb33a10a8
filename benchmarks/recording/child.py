"""A function that runs in a process of its own: `python -m benchmarks.recording.child`.

So CPU time, memory and a kill concern only what that function does. Its module, name and arguments
are passed on the command line; the answer is one line of JSON on stdout.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_RESULT = "RESULT "
_TIMEOUT = 300.0


class ChildFailed(RuntimeError):
    """Raised if a measuring process did not answer, with its last output."""


def start(work: Callable[..., dict[str, Any]], *arguments: object) -> subprocess.Popen[str]:
    """Start a process that calls `work` with arguments of JSON; paths become text."""
    words = [work.__module__, work.__name__, json.dumps(arguments, default=str)]
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.recording.child", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )


def answer(child: subprocess.Popen[str]) -> dict[str, Any]:
    """Return the answer of a measuring process, which has then ended.

    Raises:
        ChildFailed: It gave none.
    """
    try:
        out, err = child.communicate(timeout=_TIMEOUT)
    except subprocess.TimeoutExpired:
        raise ChildFailed(f"no answer within {_TIMEOUT:.0f} s") from None
    finally:
        child.kill()
    lines = [line for line in out.splitlines() if line.startswith(_RESULT)]
    if not lines:
        last = [line for line in err.splitlines() if line.strip()][-1:]
        raise ChildFailed(last[0][:160] if last else "no output")
    return dict(json.loads(lines[-1].removeprefix(_RESULT)))


def main(module: str, function: str, arguments: str) -> int:
    """Run the function; return 0, or 1 with the reason if a library is missing."""
    try:
        values = getattr(importlib.import_module(module), function)(*json.loads(arguments))
    except ImportError as error:
        print(f"{error.name or error} is not installed", file=sys.stderr)
        return 1
    print(_RESULT + json.dumps(values), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
