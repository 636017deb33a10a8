"""`tactile session recover`: close a session whose recording was killed, or seal it again."""

import argparse

from recorder.checks.recover import recover
from recorder.cli.options import add_session


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser)


def run(options: argparse.Namespace) -> int:
    """Recover the session and print its streams."""
    recovery = recover(options.session)
    width = max(18, *(len(stream.name) for stream in recovery.streams))
    for stream in recovery.streams:
        line = f"{stream.name:{width}s} {stream.rows:9d} rows"
        if stream.touched:
            line += f", {stream.recovered_rows} of them brought back"
            line += f", {stream.torn_bytes} torn bytes and {stream.dropped_rows} half rows dropped"
        print(line)
    if recovery.lost_manifests:
        runs = ", ".join(map(str, recovery.lost_manifests))
        print(f"the manifest of run {runs} was lost and made again; earlier changes cannot be seen")
    done = "recovered" if recovery.touched else "nothing to do"
    print(f"{options.session}: {done}, status {recovery.status}")
    return 0
