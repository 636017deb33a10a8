"""Command line of sessions and marker archives: `python -m recorder COMMAND`."""

import sys
from functools import partial

from recorder.command_line import run

main = partial(run.main, package="recorder")

if __name__ == "__main__":
    sys.exit(main())
