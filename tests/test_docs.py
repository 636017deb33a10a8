"""Names in the documentation exist: files, links, modules, make targets, commands, options."""

import argparse
import importlib
import importlib.util
import re
import shlex
import subprocess
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.make_names import variables_of
from support.tutorials import TUTORIALS, blocks

from benchmarks.__main__ import BENCHMARKS
from recorder.command_line.options import Parser
from tactile.commands import COMMANDS
from tactile.run import joined

ROOT = Path(__file__).parent.parent
PACKAGES = "trajectories|recorder|rig|sim|learning|benchmarks"
_PATH = re.compile(
    rf"(?<![\w./-])((?:{PACKAGES}|tests|docs|examples)/[\w./-]*\w\.(?:py|md|csv|sh))\b"
)
_DOTTED = re.compile(rf"[`\"' ](?:python -m )?((?:{PACKAGES})(?:\.[A-Za-z_]\w*)+)(?=[`\"', ]|$)")
_LOGGER = re.compile(r"getLogger\([^)]*\)")
_LINK = re.compile(r"\]\(([^)\s#]+)(?:#[^)]*)?\)")
_MAKE = re.compile(r"`make ([a-z-]+)")
_CODE = re.compile(r"^ *```(\w*)\n(.*?)^ *```|`([^`\n]+(?:\n[^`\n]+)?)`", re.M | re.S)
_COMMAND = re.compile(
    r"\s*(?:[A-Z]+=\S+ )*(tactile|make|python -m (?:tactile|benchmarks))((?: .*)?)$"
)
# Heads of pages of results: their commands are those of the commit that they name.
_HEAD = re.compile(r"(?:^\|.*\| made by \|.*\n(?:^\|.*\n)*)|(?:^Made by `[^`]*`)", re.M)
# Places of values, and marks of a usage.
_USAGE = re.compile(r"\.\.\.|\[--|\[[A-Z]+=|<\w+>|COMMAND|DIR\b")
_EITHER = re.compile(r"\\?\|[\w|\\-]+")


def _texts() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "*.md", "*.py", "Makefile"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    return [ROOT / name for name in listed if (ROOT / name).is_file()]


def _slugs(page: Path) -> set[str]:
    """Return the names of a page's headings in links, as GitHub makes them."""
    heads = re.findall(r"^#+ +(.*)$", re.sub(r"```.*?```", "", page.read_text(), flags=re.S), re.M)
    return {re.sub(r"[^\w -]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def _commands(page: Path) -> list[tuple[str, bool]]:
    """Return the command lines of a page, and whether each stands in a block of shell code."""
    found = []
    for kind, block, inline in _CODE.findall(_HEAD.sub("", page.read_text())):
        if block and kind not in ("", "sh", "bash", "console"):
            continue
        lines = re.sub(r"\\\n\s*", " ", block).splitlines() or [" ".join(inline.split())]
        for line in lines:
            if matched := _COMMAND.match(re.split(r" #|&&|;", line)[0].rstrip()):
                found.append(("".join(matched.groups()), bool(block)))
    return found


TEXTS = _texts()
PAGES = [path for path in TEXTS if path.suffix == ".md"]


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page: Path) -> None:
    links = _LINK.findall(page.read_text())
    dead = [
        link for link in links
        if not re.match(r"[a-z]+:", link) and not (page.parent / link).exists()
    ]  # fmt: skip
    # Fragments that a program inserts into a page of docs/results are linked from there.
    if page.is_relative_to(ROOT / "benchmarks"):
        dead = [link for link in dead if not (ROOT / "docs" / "results" / link).exists()]
    dead += [
        f"{link}#{place}"
        for link, place in re.findall(r"\]\(([^)\s#]*)#([^)]+)\)", page.read_text())
        if not re.match(r"[a-z]+:", link)
        and place not in _slugs(page.parent / link if link else page)
    ]
    assert not dead


@cache
def _parser(module: str) -> argparse.ArgumentParser:
    parser = Parser(prog=module)
    content: Any = importlib.import_module(module)
    content.add_arguments(parser)
    return parser


def _module(front: str, words: list[str]) -> tuple[str, list[str]] | None:
    """Return the module of a command and its arguments; None: the line names no command."""
    package = front.split()[-1]
    if package == "benchmarks":
        assert not words or words[0] in BENCHMARKS, f"{front} {words[0]}: no such benchmark"
        return (BENCHMARKS[words[0]][0], words[1:]) if words else None
    for count in (2, 1):
        if command := COMMANDS.get(" ".join(words[:count])):
            return command.module, words[count:]
    only_package = not words or words[0].startswith("--") or words in (["train"], ["session"])
    assert only_package, f"{front} {' '.join(words)}: no such command"
    return None


def _wrong(module: str, arguments: list[str], whole: bool) -> str:
    """Return the complaint about the arguments of a command, empty if there is none."""
    if "--help" in arguments:
        return ""
    if whole:
        try:
            _parser(module).parse_args(joined(arguments))
        except (Exception, SystemExit) as error:
            return str(error) or "refused"
        return ""
    known = set()
    parsers = [_parser(module)]
    for parser in parsers:
        known |= set(parser._option_string_actions)
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                parsers += action.choices.values()
    stated = {word.split("=")[0] for word in arguments if word.startswith("--")}
    return ", ".join(sorted(stated - known))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_commands_have_the_options_that_pages_give_them(page: Path) -> None:
    """A line in a block is parsed as a whole; a mention in a sentence may leave things out."""
    wrong = []
    for line, block in _commands(page):
        if line.startswith("make"):
            continue
        front, arguments = re.match(r"(python -m \w+|tactile)(.*)", line).groups()  # type: ignore[union-attr]
        whole = block and not _USAGE.search(line)
        arguments = _EITHER.sub("", arguments)
        words = shlex.split(arguments if whole else _USAGE.sub("x", arguments))
        if words[:1] == ["x"]:
            continue
        if (found := _module(front, words)) and (complaint := _wrong(*found, whole)):
            wrong.append(f"{line}: {complaint}")
    assert not wrong


def test_make_targets_have_the_variables_that_pages_give_them() -> None:
    makefile = (ROOT / "Makefile").read_text()
    wrong = []
    for page in PAGES:
        for line, _ in _commands(page):
            if matched := re.match(r"make ([a-z][a-z-]*)(.*)", line):
                given = set(re.findall(r" \[?([A-Z_]+)=", matched[2]))
                if given - (variables_of(matched[1], makefile) or given):
                    wrong.append(f"{_name(page)}: {line}")
    assert not wrong


def test_every_command_is_run_by_a_test() -> None:
    """By its words, or its module; tests of wrong inputs only see it refuse."""
    refused = ("test_docs", "test_commands", "test_wrong_inputs", "wrong_files")
    texts = [
        path.read_text()
        for path in TEXTS
        if path.is_relative_to(ROOT / "tests") and path.stem not in refused
    ]
    for command in COMMANDS.values():
        folder, _, last = command.module.rpartition(".")
        words = '", "'.join(command.words.split())
        run = re.compile(
            rf'\["{words}"|"{words}",|"{command.words} |{re.escape(command.module)}\b|'
            rf"from {re.escape(folder)} import [^)\n]*\b{last}\b"
        )
        assert any(run.search(text) for text in texts), command.words


def test_every_benchmark_is_run_by_a_test() -> None:
    text = "\n".join(path.read_text() for path in TEXTS if path.is_relative_to(ROOT / "tests"))
    text = text.replace((ROOT / "tests" / "test_docs.py").read_text(), "")
    for name, (module, _) in BENCHMARKS.items():
        folder, _, last = module.rpartition(".")
        named = (module, f"from {folder} import {last}", f'"{name}"')
        assert any(each in text for each in named), name


def test_tutorials_have_code_of_kinds_that_are_run() -> None:
    for page in TUTORIALS:
        kinds = {kind for kind, _ in blocks(page)}
        assert kinds <= {"sh", "python", "text", "console", "yaml"}, page.name


def test_files_and_modules_that_are_named_are_there() -> None:
    gone = []
    for path in TEXTS:
        text = path.read_text()
        dotted = _DOTTED.findall(_LOGGER.sub("", text))
        named = [name for name in _PATH.findall(text) if not (ROOT / name).exists()]
        named += [name for name in dotted if not name.endswith(".zarr") and not _is_there(name)]
        gone += [f"{_name(path)}: {name}" for name in named]
    assert not gone


def test_make_targets_that_are_named_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z][a-z -]*):", makefile, flags=re.M))
    known = {name for line in targets for name in line.split()}
    named = {target for page in PAGES for target in _MAKE.findall(page.read_text())}
    assert named <= known


def _is_there(dotted: str) -> bool:
    """Return True if a dotted name is a module, or a name within one."""
    words = dotted.split(".")
    for count in range(len(words), 0, -1):
        place = ROOT.joinpath(*words[:count])
        if place.is_dir() or place.with_suffix(".py").is_file():
            if count == len(words):
                return True
            source = (
                place.with_suffix(".py")
                if place.with_suffix(".py").is_file()
                else place / "__init__.py"
            )
            text = source.read_text() if source.is_file() else ""
            return re.search(rf"\b{re.escape(words[count])}\b", text) is not None
    return importlib.util.find_spec(words[0]) is not None and len(words) == 1


def test_what_is_cited_is_this_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (cited["title"], cited["version"]) == (project["name"], project["version"])
    assert cited["license"] == project["license"]
