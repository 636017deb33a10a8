"""`tactile collect`: record one session, or resume one."""

import argparse
from pathlib import Path

from rig.bench.bench import read_content
from rig.cli import squeeze
from rig.cli.options import add_page, bench_path, check_page, recording_options, sources_of
from rig.cli.recording import collect, recording_of
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    recording_options(parser, sources=True).add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="write the simulated contact's true motion and forces",
    )
    parser.description = (
        "Records one session: checks the rates of all streams, tares the gauge, and "
        "presses the targets of the bench's plan. Ctrl-C stops after the current move and loses "
        "nothing; --resume continues. Exit code 0 done, 2 wrong input, 3 device lost, 4 safety "
        "stop, 130 interrupted."
    )
    parser.epilog = "Example: tactile collect --sensor tacpalm --targets 8"
    group = parser.add_argument_group("session")
    group.add_argument(
        "--resume",
        type=Path,
        metavar="PATH",
        help="continue this stopped session (which names its sensor)",
    )
    group.add_argument(
        "--again",
        type=target_numbers,
        default=(),
        metavar="N,N,...",
        help="with --resume: press these targets again, numbered from 1 as on the page; the last "
        "press counts",
    )
    group.add_argument("--targets", type=int, metavar="N", help="press only the first N targets")
    add_page(parser, "--watch", "serve a page to watch, pause and abort")


def target_numbers(text: str) -> tuple[int, ...]:
    """Read numbers of targets from 1, as `3,7`, and return their indices from 0."""
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = [0]
    if min(numbers) < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: numbers from 1, as 3,7")
    return tuple(number - 1 for number in numbers)


def run(options: argparse.Namespace) -> int:
    """Collect; return the exit code."""
    if options.resume and (options.out or options.targets or options.indenter):
        raise ConfigError(
            "--resume: neither --out, --targets nor --indenter go with it: the session has them"
        )
    if options.again and not options.resume:
        raise ConfigError("--again: goes with --resume only")
    if options.resume is None and "fingers" in (content := read_content(bench_path(options))):
        return squeeze.run(options, content, bench_path(options))
    recording = recording_of(options)
    sources = sources_of(options, recording.file)
    if not recording.bench.mock and options.truth:
        raise ConfigError(f"--truth: {recording.file.path} is a lab bench; allowed: a mock bench")
    check_page("--watch", options.watch)
    return collect(
        recording,
        targets=options.targets,
        resumed=options.resume,
        again=options.again,
        sources=sources,
        truth=options.truth,
        watch=options.watch,
    )
