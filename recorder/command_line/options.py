"""Parser of a command, types of values, and options of commands of several packages."""

import argparse
import contextlib
import math
import shlex
from collections.abc import Callable, Iterable
from typing import Any, NoReturn, TypeVar

from recorder.command_line.errors import CommandError

Value = TypeVar("Value")


class _Help(argparse.HelpFormatter):
    """Help whose usage has only the required arguments; all options are listed below it."""

    def add_usage(
        self,
        usage: str | None,
        actions: Iterable[argparse.Action],
        groups: Iterable[argparse._MutuallyExclusiveGroup],
        prefix: str | None = None,
    ) -> None:
        """Add the usage; argparse also asks for that of subcommands, with an empty prefix."""
        choices = [group for group in groups if group.required]
        either = [action for group in choices for action in group._group_actions]
        needed = [each for each in actions if each.required or each in either]
        rest = [] if prefix == "" else [argparse.Action([], "options", nargs="?")]
        super().add_usage(usage, [*needed, *rest], choices, prefix)


class Parser(argparse.ArgumentParser):
    """Parser of one command, whose errors are one line and not preceded by all options."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"formatter_class": _Help, **settings})

    def error(self, message: str) -> NoReturn:
        """Reject the options."""
        raise CommandError(f"{message.removeprefix('argument ')}; see {self.prog} --help")


def next_command(*words: object, **options: object) -> str:
    """Return a command of `tactile` for a shell; options of None and False are left out."""
    line = ["tactile", *map(str, words)]
    for name, value in options.items():
        if value is not None and value is not False:
            line += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
    return shlex.join(line)


def reads(
    convert: Callable[[str], Value],
    allowed: str,
    accept: Callable[[Value], bool] = lambda value: True,
) -> Callable[[str], Value]:
    """Return a reader of what `convert` makes of a text; it refuses what `accept` does not."""

    def read(text: str) -> Value:
        with contextlib.suppress(ValueError):
            if accept(value := convert(text)):
                return value
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: {allowed}")

    return read


# Reader of a finite number above 0.
positive = reads(float, "a number above 0", lambda value: 0 < value < math.inf)


def whole(low: int = 1, high: int | None = None) -> Callable[[str], int]:
    """Return a reader of whole numbers from `low` to `high`."""
    allowed = f"{low} or more" if high is None else f"{low} to {high}"
    most = math.inf if high is None else high
    return reads(int, f"whole numbers, {allowed}", lambda value: low <= value <= most)


def numbers(count: int | None = None) -> Callable[[str], tuple[float, ...]]:
    """Return a reader of comma-separated numbers: `count` of them, or one or more."""
    allowed = f"{count} numbers" if count else "numbers"
    example = ",".join(["1.5", "2", "0"][: count or 3])
    return reads(
        lambda text: tuple(float(part) for part in text.split(",")),
        f"{allowed} between commas, such as {example}",
        lambda values: len(values) == (count or len(values)),
    )


# Reader of comma-separated names.
names = reads(lambda text: tuple(text.split(",")), "names between commas", all)


def names_or_none(text: str) -> tuple[str, ...]:
    """Read comma-separated names; an empty text is the empty list."""
    return names(text) if text else ()


def add_value(
    parser: argparse._ActionsContainer,
    flag: str,
    metavar: str,
    default: object,
    about: str,
    read: Callable[[str], Any] = float,
) -> None:
    """Add an option that has a default, which its help states after `about`."""
    parts = default if isinstance(default, tuple) else (default,)
    stated = ",".join(f"{part:g}" if isinstance(part, float) else str(part) for part in parts)
    parser.add_argument(
        flag, type=read, default=default, metavar=metavar, help=f"{about} ({stated})"
    )


def add_device(parser: argparse._ActionsContainer, purpose: str = "device") -> None:
    """Add `--device`, the CPU unless another is named."""
    add_value(parser, "--device", "NAME", "cpu", f"{purpose}: cpu, or cuda:0 and the like", str)


def add_seed(parser: argparse._ActionsContainer) -> None:
    """Add `--seed`, the seed of all random draws."""
    add_value(parser, "--seed", "N", 0, "seed of random draws", whole(0))


def add_grid(parser: argparse._ActionsContainer, default: int = 64) -> None:
    """Add `--grid`, the number of pixels of tier `layer`."""
    add_value(parser, "--grid", "N", default, "pixels along the longer side", whole(16, 256))
