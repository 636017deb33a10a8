"""Command line of learning: `python -m learning COMMAND`."""

import sys
from functools import partial

from recorder.command_line import run

main = partial(run.main, package="learning")

if __name__ == "__main__":
    sys.exit(main())
