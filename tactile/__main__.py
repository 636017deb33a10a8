"""Command line of the project, `tactile COMMAND`; the commands are listed in `commands.py`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from tactile.commands import COMMANDS, EXTRAS, FAMILIES, FRONTS, GROUPS, Command

EXIT_WRONG_INPUT = 2
HELP = ("-h", "--help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words:
        print(overview(), file=sys.stderr)
        return EXIT_WRONG_INPUT
    first, *rest = words
    if first in HELP:
        print(overview())
        return 0
    if first == "--version":
        from importlib.metadata import version

        print(f"tactile-rig {version('tactile-rig')}")
        return 0
    if first not in FAMILIES:
        return _run(COMMANDS[first], rest) if first in COMMANDS else _unknown(first, _firsts())
    if not rest:
        print(family(first), file=sys.stderr)
        return EXIT_WRONG_INPUT
    if rest[0] in HELP:
        print(family(first))
        return 0
    known = COMMANDS.get(f"{first} {rest[0]}")
    return _run(known, rest[1:]) if known else _unknown(f"{first} {rest[0]}", _seconds(first))


def overview() -> str:
    """Return the help of all commands, by group."""
    width = max(map(len, COMMANDS))
    lines = ["usage: tactile COMMAND [options]; see tactile COMMAND --help"]
    for title, commands in GROUPS.items():
        lines += ["", title, *_rows(commands, width)]
    return "\n".join(lines)


def family(first: str) -> str:
    """Return the help of the commands that begin with a word."""
    commands = [COMMANDS[words] for words in _seconds(first)]
    width = max(len(command.words) for command in commands)
    usage = f"usage: tactile {first} COMMAND [options]; see tactile {first} COMMAND --help"
    return "\n".join([usage, "", f"{FAMILIES[first]}:", *_rows(commands, width)])


def _rows(commands: Iterable[Command], width: int) -> list[str]:
    return [f"  {command.words:{width}}  {command.help}" for command in commands]


def _firsts() -> list[str]:
    return list(dict.fromkeys(words.split()[0] for words in COMMANDS))


def _seconds(first: str) -> list[str]:
    return [words for words in COMMANDS if words.startswith(f"{first} ")]


def _unknown(words: str, known: Sequence[str]) -> int:
    """Print that the command is unknown, with similar ones; return the exit code."""
    from difflib import get_close_matches

    last = words.split()[-1]
    # A last word alone means the full command: `check` is `session check`; also `train-force`.
    same = [each for each in COMMANDS if last in (each.split()[-1], each.replace(" ", "-"))]
    near = same or get_close_matches(words, [*COMMANDS, *known])
    hint = f"did you mean {', '.join(near)}? " if near else ""
    print(
        f"wrong input: {words!r}: no such command; {hint}tactile --help lists all commands",
        file=sys.stderr,
    )
    return EXIT_WRONG_INPUT


def _run(command: Command, rest: Sequence[str]) -> int:
    """Run a command through its package, with `tactile` as the program name."""
    import argparse
    from importlib import import_module

    try:
        module = import_module(command.module)
        front = import_module(FRONTS[command.package])
        *before, _ = command.words.split()
        parser = argparse.ArgumentParser(prog="tactile")
        subcommands = parser.add_subparsers(dest="verb", prog=" ".join(["tactile", *before]))
        module.add_to(subcommands)
        subcommands.choices[command.name].prog = f"tactile {command.words}"
        return int(front.run(parser, [command.name, *rest]))
    except ModuleNotFoundError as error:
        extra = command.extra or EXTRAS[command.package]
        if not extra or (error.name or "").partition(".")[0] in EXTRAS:
            raise
        print(
            f"wrong input: tactile {command.words}: {error.name} is not installed; install the "
            f"extra: pip install 'tactile-rig[{extra}]'",
            file=sys.stderr,
        )
        return EXIT_WRONG_INPUT


if __name__ == "__main__":
    sys.exit(main())
