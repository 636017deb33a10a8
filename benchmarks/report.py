"""A benchmark is a question and a list of parts; each part is measured, stored, and shown.

`Benchmark` has the options that all benchmarks share, measures the chosen parts with a progress
bar, writes what each measured to a JSON file beside the page as soon as it is there, and writes the
page: a head (command, machine, commit, seeds, spread, time), then a section for each part, with its
pictures in `images/`. `--draw` writes the page again from the JSON file.
"""

import argparse
import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recorder.command_line.errors import CommandError
from recorder.command_line.options import add_device
from recorder.progress import Progress, span_of
from recorder.store.files import replace_file

ROOT = Path(__file__).parent.parent
# Pages of complete runs, and of quick ones.
RESULTS, QUICK_RESULTS = ROOT / "docs" / "results", ROOT / "build" / "results"
# Exit code of a run in which something failed that must hold.
FAILED = 1
# Rows of interrupted parts in the JSON file, and options that change none of them.
PARTIAL, PAGE = "partial", ("only", "draw", "out")


@dataclass
class Run:
    """Settings of a measurement, and its statements about itself."""

    options: argparse.Namespace
    """The options of the command line, those of the benchmark included."""
    folder: Path
    """Folder of its own for files; it is removed afterwards."""
    progress: Callable[[float], None]
    """Called with the fraction done, 0 to 1."""
    seeds: Sequence[int] = ()
    """Seeds that were used; empty: nothing was random."""
    spread: str = ""
    """Spread of repeated runs, e.g. `median of 5 runs, range at most 4 %`; empty: a single run."""
    failures: list[str] = field(default_factory=list)
    """Statements that must hold and do not; any makes the exit code 1."""
    rows: dict[str, Any] = field(default_factory=dict)
    """Values of `once`, those of an interrupted run included."""
    store: Callable[[], None] = lambda: None
    """Writes `rows` to the JSON file."""

    def once(self, name: str, work: Callable[[], Any]) -> Any:
        """Return the value, in JSON, that an interrupted run has stored, or that of `work`.

        It is stored at once, so that an interrupted part loses only the value it was at.
        """
        if name not in self.rows:
            self.rows[name] = work()
            self.store()
        return self.rows[name]

    @property
    def quick(self) -> bool:
        """Return True if the run must end soon, with numbers that mean little."""
        return bool(self.options.quick)

    @property
    def device(self) -> str:
        """`cpu`, or a CUDA device."""
        return str(getattr(self.options, "device", "cpu"))


@dataclass(frozen=True)
class Page:
    """Where a section is written."""

    path: Path

    def picture(self, name: str) -> Path:
        """Return where to save a picture of the page; its folder exists."""
        path = self.path.parent / "images" / f"{self.path.stem}-{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def link(self, name: str, text: str) -> str:
        """Return the Markdown that shows a picture saved at `picture(name)`."""
        return f"![{text}](images/{self.path.stem}-{name}.png)"


@dataclass(frozen=True)
class Part:
    """One part of a benchmark."""

    name: str
    measure: Callable[[Run], Any]
    """Measures, and returns values of JSON."""
    section: Callable[[Any, Page], str]
    """Returns the Markdown of those values, with headings of the second level; draws pictures."""
    weight: float = 1.0
    """Expected share of the time, relative to the other parts."""
    needs: str = ""
    """Extra or device without which it cannot run, for the help; empty: nothing."""


@dataclass(frozen=True)
class Benchmark:
    """One question, the command that answers it, and its page."""

    name: str
    title: str
    question: str
    """The page answers it: a sentence or a few, its first paragraph."""
    parts: Sequence[Part]
    summary: Callable[[dict[str, Any]], str] | None = None
    """Returns the Markdown above the sections, from the values by part; of those there are."""
    options: Callable[[argparse.ArgumentParser], None] | None = None
    """Adds options of its own."""
    on_device: bool = False
    """True if it has `--device`."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the options of the command."""
        names = [part.name for part in self.parts]
        needs = [
            f"{part.name} (needs {part.needs})" if part.needs else part.name for part in self.parts
        ]
        parser.description = f"{self.question} Parts: {', '.join(needs)}."
        parser.add_argument(
            "--quick",
            action="store_true",
            help="ends in two minutes; its numbers mean little, its page goes to build/results",
        )
        either = parser.add_mutually_exclusive_group()
        either.add_argument(
            "--only",
            action="append",
            choices=names,
            help="measure this part (may be repeated); the page keeps the other parts",
        )
        either.add_argument(
            "--draw", action="store_true", help="measure nothing: write the page from its JSON file"
        )
        parser.add_argument(
            "--out",
            type=Path,
            metavar="PAGE",
            help=f"page to write, JSON beside it (default: docs/results/{self.name}.md)",
        )
        if self.on_device:
            add_device(parser)
        if self.options is not None:
            self.options(parser)

    def run(self, options: argparse.Namespace) -> int:
        """Measure the parts, write the page, and return the exit code.

        What Ctrl-C or an error leaves of a run is in the JSON file, from which `--draw` makes the
        page, and with which the next run with the same options, machine and commit goes on in a
        part that was interrupted.

        Raises:
            CommandError: `--draw` without a JSON file, or one that does not fit.
        """
        path = options.out or (QUICK_RESULTS if options.quick else RESULTS) / f"{self.name}.md"
        if path.suffix != ".md" or path.is_dir():
            raise CommandError(
                f"--out: found {str(path)!r}; allowed: a file whose name ends in .md"
            )
        measurements = path.with_suffix(".json")
        stored = self._stored(measurements)
        if options.draw:
            if not any(part.name in stored for part in self.parts):
                raise CommandError(f"--draw: {measurements}: no measured part")
            self._write(path, stored)
            return 0
        chosen = [part for part in self.parts if not options.only or part.name in options.only]
        whole, before, failures = sum(part.weight for part in chosen), 0.0, []
        origin = (machine_name(str(getattr(options, "device", "cpu"))), commit())
        _store(measurements, stored)  # a place that cannot be written to is refused now
        with Progress(self.name, sys.stderr) as progress:
            for part in chosen:
                fraction = part.weight / whole
                with tempfile.TemporaryDirectory(prefix=f"{self.name}-") as folder:
                    run = Run(options, Path(folder), span_of(progress, before, fraction))
                    seconds = _resume(run, origin, part.name, self._stored, measurements)
                    values = part.measure(run)
                before += fraction
                stored = self._stored(measurements)  # with what another run has measured meanwhile
                stored[PARTIAL].pop(part.name, None)
                stored[part.name] = _head(run, origin, seconds()) | {"results": values}
                failures += [f"{part.name}: {failure}" for failure in run.failures]
                _store(measurements, stored)
        self._write(path, stored, measured=[part.name for part in chosen])
        for failure in failures:
            print(f"FAILED: {failure}")
        return FAILED if failures else 0

    def _stored(self, path: Path) -> dict[str, Any]:
        """Return a JSON file's values of this benchmark's parts; nothing if there is no file."""
        if not path.exists():
            return {PARTIAL: {}}
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise CommandError(f"{path}: not JSON: {error}") from None
        if not isinstance(document, dict):
            raise CommandError(f"{path}: not the measurements of a benchmark")
        names = [part.name for part in self.parts if part.name in document]
        return {name: document[name] for name in names} | {PARTIAL: document.get(PARTIAL, {})}

    def _write(self, path: Path, stored: dict[str, Any], measured: Sequence[str] = ()) -> None:
        """Write the page of the stored values, and name the files written.

        Values that were not `measured` now may come from another version of the benchmark.
        """
        there = [part for part in self.parts if part.name in stored]
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            values = {part.name: stored[part.name]["results"] for part in there}
            absent = ", ".join(part.name for part in self.parts if part.name not in stored)
            texts = [f"# {self.title}", self.question, _made([*values], stored, path)]
            texts.append(absent and f"**Not measured:** {absent}.")
            texts += [
                f"**Failed:** {name}: {failure}"
                for name in values
                for failure in stored[name].get("failures", ())
            ]
            if self.summary is not None:
                texts.append(self.summary(values))
            texts += [part.section(values[part.name], Page(path)) for part in there]
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            if {part.name for part in there} <= set(measured):
                raise
            raise CommandError(
                f"{path.with_suffix('.json')}: does not fit this version of the benchmark, "
                f"measure again: {type(error).__name__}: {error}"
            ) from error
        page = "\n\n".join(text.strip() for text in texts if text)
        path.write_text(f"{page}\n", encoding="utf-8")
        print(f"written: {path}, {path.with_suffix('.json').name}")


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table; columns of numbers, except the first, are aligned to the right."""
    cells = [list(map(str, row)) for row in rows]
    sides = "".join(
        "---:|" if column and all(_NUMBER.match(row[column]) for row in cells) else "---|"
        for column in range(len(head))
    )
    first, *lines = ("| " + " | ".join(row) + " |" for row in [list(head), *cells])
    return "\n".join([first, f"|{sides}", *lines])


# Begins like a number, after signs or in bold, or has no word: no value.
_NUMBER = re.compile(r"\W*(\d|$)|none|nan")


def machine_name(device: str = "cpu") -> str:
    """Return the name of the processor, and of the GPU if `device` is one."""
    model, described = platform.machine(), Path("/proc/cpuinfo")
    if described.exists() and (found := re.search(r"model name\s*:(.*)", described.read_text())):
        model = found[1].strip()
    cores = f"{model}, {len(os.sched_getaffinity(0))} cores"
    if device == "cpu":
        return cores
    import warp as wp

    from sim.device import ready_device

    ready_device(device)
    return f"{wp.get_device(device).name} ({cores})"


def commit() -> str:
    """Return the commit's short name, with `+` if code differs from it; `unknown` without git.

    `TACTILE_COMMIT` in the environment replaces it, for a copy that has no repository.
    """

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    if named := os.environ.get("TACTILE_COMMIT"):
        return named
    try:
        if Path(git("rev-parse", "--show-toplevel")) != ROOT.resolve():
            return "unknown"
        changed = git("status", "--porcelain", "--", ".", ":!docs", ":!*.md")
        return git("rev-parse", "--short=8", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _head(run: Run, origin: tuple[str, str], seconds: float) -> dict[str, Any]:
    machine, version = origin
    return {
        "command": shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]]),
        "quick": run.quick,
        "machine": machine,
        "python": platform.python_version(),
        "commit": version,
        "seeds": list(run.seeds),
        "spread": run.spread,
        "seconds": round(seconds, 1),
        "failures": list(run.failures),
    }


def _made(names: Sequence[str], stored: dict[str, Any], path: Path) -> str:
    """Return the head of the page: one line if all parts were measured alike, and a table."""
    heads = [stored[name] for name in names]
    shared = {
        key: {json.dumps(head[key]) for head in heads}
        for key in ("command", "machine", "python", "commit")
    }
    measured = f"[measurements]({path.with_suffix('.json').name})"
    hasty = [name for name, head in zip(names, heads, strict=True) if head["quick"]]
    quick = f"**Quick runs, whose numbers mean little: {', '.join(hasty)}.** " if hasty else ""
    rows = [
        [name, _seeds(head), head["spread"] or "single run", _minutes(head["seconds"])]
        for name, head in zip(names, heads, strict=True)
    ]
    columns = ["part", "seeds", "spread", "took"]
    if all(len(values) == 1 for values in shared.values()):
        made = "Made by `{command}` on {machine}, Python {python}, commit {commit}".format(
            **heads[0]
        )
    else:
        made = "Parts were measured one by one"
        columns += ["made by", "machine", "commit"]
        for row, head in zip(rows, heads, strict=True):
            row += [f"`{head['command']}`", head["machine"], head["commit"]]
    return f"{quick}{made}; {measured}.\n\n{table(columns, rows)}"


def _seeds(head: dict[str, Any]) -> str:
    seeds = head["seeds"]
    if len(seeds) > 3 and seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds)) or "none"


def _minutes(seconds: float) -> str:
    if math.isnan(seconds):
        return "not recorded"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def _resume(
    run: Run, origin: tuple[str, str], name: str, read: Callable[[Path], dict[str, Any]], path: Path
) -> Callable[[], float]:
    """Give a run the rows of one interrupted with the same options, machine and commit (`origin`).

    Return the clock of both [s]. If code differs from the commit, no row is used.
    """
    chosen = [f"{key}={value}" for key, value in vars(run.options).items() if key not in PAGE]
    head = [*chosen, *origin]
    last = read(path)[PARTIAL].get(name, {})
    if last.get("head") != head or head[-1].endswith(("+", "unknown")):
        last = {"rows": {}, "seconds": 0.0}
    run.rows, began = last["rows"], time.monotonic()

    def seconds() -> float:
        return float(last["seconds"]) + time.monotonic() - began

    def store() -> None:
        stored = read(path)
        stored[PARTIAL][name] = {"head": head, "seconds": seconds(), "rows": run.rows}
        _store(path, stored)

    run.store = store
    return seconds


def _store(path: Path, stored: dict[str, Any]) -> None:
    """Write the JSON file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {name: values for name, values in stored.items() if values}
    text = json.dumps(kept, indent=1, allow_nan=True)
    # A list of numbers stands on one line; line ends in strings are escaped.
    text = re.sub(r"\[[^][{}\"]*\]", lambda numbers: re.sub(r"\n *", "", numbers[0]), text)
    replace_file(path, f"{text}\n".encode())
