"""The commands and options of the whole program: their number and their help."""

import argparse
import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from recorder.command_line.options import Parser
from tactile.commands import COMMANDS

ROOT = Path(__file__).parents[2]
PACKAGES = ("trajectories", "recorder", "rig", "sim", "learning", "tactile")
COMMANDS_MOST, OPTIONS_MOST = 38, 400


def parsers(words: str) -> Iterator[argparse.ArgumentParser]:
    """Yield the parser of a command, and those of its verbs."""
    module: Any = importlib.import_module(COMMANDS[words].module)
    parser = Parser(prog=f"tactile {words}")
    module.add_arguments(parser)
    waiting: list[argparse.ArgumentParser] = [parser]
    while waiting:
        parser = waiting.pop()
        yield parser
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                waiting += action.choices.values()


def options(words: str) -> list[argparse.Action]:
    """Return the options of a command, without --help."""
    return [
        action
        for parser in parsers(words)
        for action in parser._actions
        if action.option_strings and action.dest != "help" and action.help != argparse.SUPPRESS
    ]


def test_a_newcomer_can_read_all_of_it() -> None:
    assert len(COMMANDS) <= COMMANDS_MOST
    assert sum(len(options(words)) for words in COMMANDS) <= OPTIONS_MOST


@pytest.mark.parametrize("words", COMMANDS)
def test_every_option_says_its_default_and_its_unit_in_words(words: str) -> None:
    wrong = []
    for parser in parsers(words):
        formatter = parser._get_formatter()
        for action in parser._actions:
            if action.dest == "help" or action.help == argparse.SUPPRESS:
                continue
            name = "/".join(action.option_strings) or str(action.metavar or action.dest)
            if not action.help:
                wrong.append(f"{name}: no help")
                continue
            text = formatter._expand_help(action)
            # A default stands in parentheses: lengths [mm] (0.1).
            stated = "default" in text or re.search(r"\([^)]+\)", text)
            unset = (None, False, True, argparse.SUPPRESS, (), [], "")
            if action.option_strings and action.default not in unset and not stated:
                wrong.append(f"{name}: its default {action.default!r} is not said: {text}")
            if re.search(r"\[n\]|\[\w+_\w+\]|%%", text):
                wrong.append(f"{name}: {text}")
    assert not wrong


def test_the_commands_to_continue_with_exist_and_have_their_options() -> None:
    wrong, calls = [], 0
    for path in [each for package in PACKAGES for each in (ROOT / package).rglob("*.py")]:
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if "next_command(" in text else ():
            if not isinstance(node, ast.Call) or ast.unparse(node.func) != "next_command":
                continue
            given = [each.value for each in node.args if isinstance(each, ast.Constant)]
            words = next((text for n in (2, 1) if (text := " ".join(given[:n])) in COMMANDS), None)
            if given and words is None:
                wrong.append(f"{path}:{node.lineno}: {given}: no such command")
            if words is None:
                continue
            calls += 1
            known = {name for option in options(words) for name in option.option_strings}
            stated = {f"--{key.arg.replace('_', '-')}" for key in node.keywords if key.arg}
            if stated - known:
                wrong.append(f"{path}:{node.lineno}: {words}: {sorted(stated - known)}")
    assert wrong == []
    assert calls > 10
