"""`tactile import`: make sessions, or a marker archive, of recordings made elsewhere."""

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from recorder import doubts
from recorder.command_line.options import next_command
from recorder.command_line.terminal import paint
from recorder.convert import (
    Answers,
    As,
    Draft,
    MissingAnswer,
    default_stream,
    draft_recordings,
    option_flag,
    rate_option,
    write_page,
    write_sessions,
)
from recorder.errors import SessionError
from recorder.progress import ItemProgress
from recorder.session import Session
from recorder.settings import Reader
from tactile import import_genforce

_NAME = re.compile("[A-Za-z][A-Za-z0-9_]*")
# Kinds of files that have an option of their own.
_FILES: tuple[As, ...] = ("video", "force", "taxels", "width", "pose")
_UNPLACED = (
    "Places and depths are unknown: no press can be joined with another sensor's, but a model of "
    "the sensor's own can be trained"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Finds out what files and folders hold (videos, folders of images, CSV, NPY, NPZ, MCAP, "
        "rosbags, LeRobot, uSkin logs; other tables and HDF5 with --columns), finds the contacts, "
        "draws a page to approve and writes sessions. Asks for what the files do not tell; "
        "without a terminal it names the option. A folder of the GenForce recordings becomes a "
        "marker archive, repeat the command to continue; a file of their weights (.pkl, .pth) the "
        "folder of a trained model."
    )
    add = parser.add_argument
    add("paths", nargs="+", type=Path, metavar="PATH", help="files or folders of recordings")
    add("--out", type=Path, metavar="PATH", help="session to write; a folder for several objects")
    add("--yes", action="store_true", help="write without asking for approval of the page")
    add("--page", type=Path, metavar="HTML", help="page to draw (beside --out)")
    add("--like", type=Path, metavar="SESSION", help="take the answers of an earlier import")
    files = parser.add_argument_group("files whose kind is stated; all are one recording")
    for name in _FILES:
        files.add_argument(
            f"--{name}",
            action="append",
            default=[],
            metavar="[STREAM=]PATH",
            help=f"a file of kind {name}; may be repeated, with names of the streams",
        )
    unknown = parser.add_argument_group("what files may not tell")
    for flag, option in Answers.options():
        unknown.add_argument(flag, **option)
    import_genforce.add_options(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    stated = _stated(options)
    if options.out is None and stated and len(options.paths) == 1:
        # As it was once written: tactile import SESSION --video FILE --force FILE.
        options.out, options.paths = options.paths[0], []
    if options.out is None:
        raise SessionError("--out: missing; allowed: the session or folder to write")
    alone = len(options.paths) == 1
    if alone and not stated and options.paths[0].suffix in import_genforce.WEIGHTS:
        return import_genforce.import_weights(options.paths[0], options)
    if not stated and import_genforce.layout_among(options.paths):
        return import_genforce.import_folder(options.paths[0], options)
    answers, drafts = _drafts(options, stated)
    for line in _grouped([line for draft in drafts for line in draft.assumed]):
        print(line)
    position_note = "Places and depths come from the poses" if answers.contact_frame else _UNPLACED
    print(position_note)
    page = options.page or options.out.with_name(options.out.name + ".import.html")
    write_page(drafts, page, sensor=answers.sensor, places=position_note + ".")
    print(f"{page}: look at it before you use the data")
    if not options.yes and not _approved(options.out):
        return 0
    with ItemProgress("rows", sys.stderr) as progress:
        written = write_sessions(drafts, options.out, answers, progress)
    presses = sum(len(draft.presses) for draft in drafts)
    for path in written:
        print(f"{path}: imported")
        for doubt in doubts(Session(path)):
            print(paint(str(doubt), doubt.level))
    print(f"{len(drafts)} recordings, {presses} presses, {len(written)} sessions")
    kinds = {track.kind for draft in drafts for track in draft.take.tracks}
    if not kinds & {"video", "taxels"}:
        print("no images or taxels: nothing to make markers of")
        return 0
    preset, choice = _preset_words(answers.sensor, taxels="taxels" in kinds)
    archive = Path(f"{options.out.with_suffix('')}.markers.zarr")
    print(f"next: {next_command('markers', *written, *preset, out=archive)}")
    if choice:
        print(choice)
    return 0


def _preset_words(sensor: str, *, taxels: bool) -> tuple[list[str], str]:
    """Return the options of `markers` for the sensor, and hints on their values."""
    try:
        from learning.markers import names, preset_of_sensor
    except ModuleNotFoundError:  # `markers` names the missing extra
        return [], ""
    if preset_of_sensor(sensor) is not None:
        return [], ""
    if taxels:
        return ["--preset", "uskin"], ""
    return ["--preset", "PRESET", "--mm-per-px", "MM"], (
        "PRESET: shading for a gel without markers; else the file that `tactile markers-fit` "
        f"writes, or one of {', '.join(names())}. MM: size of a pixel of the 640 x 480 [mm]"
    )


def _grouped(lines: Sequence[str]) -> list[str]:
    """Return messages `NAME: text`, those of one text in one line."""
    names: dict[str, list[str]] = {}
    for line in dict.fromkeys(lines):
        name, _, text = line.partition(": ")
        names.setdefault(text, []).append(name)
    return [
        f"{', '.join(of[:3])}{f' and {len(of) - 3} more' if len(of) > 3 else ''}: {text}"
        for text, of in names.items()
    ]


def _stated(options: argparse.Namespace) -> list[tuple[As, str, Path]]:
    """Return kind, stream and path of the files whose kind is stated."""
    files: list[tuple[As, str, Path]] = []
    for kind in _FILES:
        names: set[str] = set()
        for text in getattr(options, kind):
            name, equals, value = text.partition("=")
            if not equals or not _NAME.fullmatch(name):
                name, value = "", text
            if name in names:
                raise SessionError(
                    f"--{kind}: found {name or value!r} twice; name them: --{kind} NAME=..."
                )
            names.add(name)
            files.append((kind, name, Path(value)))
    return files


def _drafts(
    options: argparse.Namespace, stated: Sequence[tuple[As, str, Path]]
) -> tuple[Answers, list[Draft]]:
    """Return the answers and the recordings; ask for what is missing if there is a terminal."""
    answers = Answers()
    if options.like is not None:
        imported = Session(options.like).attrs.get("imported", {})
        answers = Answers.from_json(imported.get("answers"), str(options.like))
    values = {each.name: getattr(options, each.name, None) for each in fields(Answers)}
    mappings = [Path(each) for each in options.columns or ()]
    read = Reader(SessionError).read
    values["columns"] = [(path.name, read(path)) for path in mappings] or None
    answers = answers.with_values({name: each for name, each in values.items() if each is not None})
    _require_rates(answers, stated, options.paths)
    while True:
        try:
            return answers, draft_recordings(options.paths, stated, answers)
        except MissingAnswer as missing:
            if not sys.stdin.isatty() or options.yes:
                raise
            answers = _with_typed_answer(answers, missing)


def _require_rates(
    answers: Answers, stated: Sequence[tuple[As, str, Path]], paths: Sequence[Path]
) -> None:
    """Reject a rate of a stream that no stated file has."""
    if paths:
        return
    for option in ("fps", "force_hz", "taxels_hz"):
        streams = {
            stream or default_stream(kind)
            for kind, stream, _ in stated
            if rate_option(kind) == option
        }
        for text in getattr(answers, option):
            name, equals, rate = text.rpartition("=")
            if not streams or (equals and name not in streams):
                of_stream = f" of {name}" if equals else ""
                raise SessionError(
                    f"{option_flag(option)}: found {rate}{of_stream} without the file it is the "
                    "rate of"
                )


def _with_typed_answer(answers: Answers, missing: MissingAnswer) -> Answers:
    """Return the answers with one more, typed at the terminal."""
    print(missing, file=sys.stderr)
    text = input(f"{option_flag(missing.option)}: ").strip()
    name = "kinds" if missing.option == "as" else missing.option
    value: Any = text
    if name == "lag":
        try:
            value = float(text)
        except ValueError:
            raise SessionError(f"--lag: found {text!r}; allowed: seconds") from None
    elif isinstance(getattr(answers, name), tuple):
        value = (*getattr(answers, name), text)
    if not text:
        raise SessionError(f"{option_flag(missing.option)}: found no answer")
    return answers.with_values({name: value})


def _approved(out: Path) -> bool:
    """Return True if a person at the terminal approves the page."""
    if not sys.stdin.isatty():
        raise SessionError(f"{out}: not written; look at the page, then repeat with --yes")
    return input(f"write {out}? [y/N] ").strip().lower() in ("y", "yes")
