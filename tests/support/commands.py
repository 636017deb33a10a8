"""Run the module of a command without the handling of its errors."""

import argparse
from typing import Any


def run_module(module: Any, *words: object) -> int:
    """Parse the options in `words`, run the module and return its exit code."""
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    return int(module.run(parser.parse_args([*map(str, words)])))
