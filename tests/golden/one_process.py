"""Run many command lines in one process; print [exit code, output, errors] of each as JSON."""

from __future__ import annotations

import json
import os
import runpy
import sys
import tempfile
import traceback


def run(package: str, arguments: list[str]) -> tuple[int, str, str]:
    """Run `python -m PACKAGE ARGUMENTS` in this process."""
    kept = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as erred:
        os.dup2(printed.fileno(), 1)
        os.dup2(erred.fileno(), 2)
        try:
            code = _code(package, arguments)
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            for number, before in zip((1, 2), kept, strict=True):
                os.dup2(before, number)
                os.close(before)
        texts = []
        for file in (printed, erred):
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
    return code, texts[0], texts[1]


def _code(package: str, arguments: list[str]) -> int:
    sys.argv = [package, *arguments]
    try:
        runpy.run_module(package, run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
            return 1
        return ended.code or 0
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    lines = json.loads(sys.argv[1])
    sys.path[0] = os.getcwd()
    print(json.dumps([run(package, arguments) for package, *arguments in lines]))
