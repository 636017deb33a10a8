"""Run a command of the table: find it, parse its options, and end it with an exit code.

The module of a command has `add_arguments(parser)` and `run(options)`, which returns the exit code.
"""

import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from io import TextIOWrapper
from typing import Any

from recorder.command_line.errors import EXIT_WRONG_INPUT, failure
from recorder.command_line.extras import extra_of
from tactile.commands import COMMANDS, EXTRAS, FAMILIES, GROUPS, INTERRUPTED, Command

HELP = ("-h", "--help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command of `tactile` and return the exit code.

    A character that the terminal does not have is shown by its code.
    Threads of torch and the like that wait for each other sleep instead of spinning, unless
    `OMP_WAIT_POLICY` is set: where cores are shared with others, spinning takes the cores that the
    awaited threads need.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
        # The same for processes that a command starts.
        os.environ["PYTHONIOENCODING"] = f"{sys.stdout.encoding}:backslashreplace"
    if not os.access(os.path.expanduser("~"), os.W_OK):
        _keep_caches_elsewhere()
    words = list(sys.argv[1:] if argv is None else argv)
    for count in (2, 1):
        if command := COMMANDS.get(" ".join(words[:count])):
            return _run(command, words[count:])
    if words == ["--version"]:
        from importlib.metadata import version

        print(f"tactile-rig {version('tactile-rig')}")
        return 0
    family = words[0] if words and words[0] in FAMILIES else ""
    rest = words[1:] if family else words
    if rest and rest[0] not in HELP:
        return _unknown(" ".join(words[:2] if family else words[:1]))

    def show() -> int:
        print(overview(family), file=sys.stdout if rest else sys.stderr)
        return 0 if rest else EXIT_WRONG_INPUT

    return ended(show)


def _keep_caches_elsewhere() -> None:
    """Have libraries keep compiled code and settings in a folder of the user for temporary files.

    A folder there that belongs to another user is not used: its code would run as ours.
    """
    folder = os.path.join(tempfile.gettempdir(), f"tactile-rig-{os.getuid()}")
    os.makedirs(folder, 0o700, exist_ok=True)
    if os.lstat(folder).st_uid == os.getuid():
        for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
            os.environ.setdefault(name, folder)


def overview(family: str = "") -> str:
    """Return the help of all commands by group, or of those with one first word."""
    start = f"tactile {family}".strip()
    lines = [f"usage: {start} COMMAND [options]; see {start} COMMAND --help"]
    topic = FAMILIES.get(family)
    if topic:
        lines += ["", f"{topic}:"]
    listed = {
        name: each for name, each in COMMANDS.items() if not family or name.startswith(f"{family} ")
    }
    width = max(map(len, listed))
    for title, group in GROUPS.items():
        rows = [f"  {name:{width}}  {each.help}" for name, each in listed.items() if each in group]
        if rows:
            lines += rows if topic else ["", title, *rows]
    return "\n".join(lines)


def run_module(
    name: str, argv: Iterable[str], *, prog: str, description: str = "", interrupted: str = ""
) -> int:
    """Import the module of a command, parse its options, run it and return the exit code.

    Without a description, that in the help is the module's docstring. `interrupted` is what Ctrl-C
    leads to, printed when it has ended the command.
    """

    def call() -> int:
        from recorder.command_line.options import Parser

        module: Any = import_module(name)
        parser = Parser(prog=prog, description=description or module.__doc__)
        module.add_arguments(parser)
        return int(module.run(parser.parse_args(joined(argv))))

    return ended(call, interrupted)


def ended(call: Callable[[], int], interrupted: str = "") -> int:
    """Return the exit code of `call`; print the line of a known error or of Ctrl-C."""
    try:
        code = call()
        sys.stdout.flush()
    except BaseException as error:
        return failure(error, interrupted)
    return code


def joined(argv: Iterable[str]) -> list[str]:
    """Return `argv` with values such as `-4,0` joined to the option before them by `=`.

    argparse would take them for options: it recognises negative numbers, but no lists of them.
    """
    tied: list[str] = []
    for argument in argv:
        after_option = bool(tied) and tied[-1].startswith("--") and "=" not in tied[-1]
        if after_option and re.match(r"-[.\d][^=]*,", argument):
            tied[-1] += f"={argument}"
        else:
            tied.append(argument)
    return tied


def _run(command: Command, argv: Sequence[str]) -> int:
    prog = f"tactile {command.words}"
    try:
        return run_module(
            command.module,
            argv,
            prog=prog,
            description=f"{command.help[0].upper()}{command.help[1:]}.",
            interrupted=INTERRUPTED.get(command.package, ""),
        )
    except ModuleNotFoundError as error:
        extra = extra_of(error.name or "", command.extra or EXTRAS[command.package])
        if not extra:
            raise
        print(
            f"wrong input: {prog}: {error.name} is not installed; install the extra: "
            f"pip install 'tactile-rig[{extra}]'",
            file=sys.stderr,
        )
        return EXIT_WRONG_INPUT


def _unknown(words: str) -> int:
    """Print that the command is unknown, with similar ones; return the exit code."""
    from difflib import get_close_matches

    last = words.split()[-1]
    # A last word alone means the full command: `check` is `session check`; also `train-force`.
    same = [each for each in COMMANDS if last in (each.split()[-1], each.replace(" ", "-"))]
    near = same or get_close_matches(words, COMMANDS)
    hint = f"did you mean {', '.join(near)}? " if near else ""
    print(
        f"wrong input: {words!r}: no such command; {hint}tactile --help lists all commands",
        file=sys.stderr,
    )
    return EXIT_WRONG_INPUT
