"""Make variables that a target does not read are refused: make itself ignores them."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "Makefile").read_text()
# The line of options, the names of targets, and the rest of the rule.
RULES = list(
    re.finditer(
        r"(?:^#: (?P<options>.*)\n)?^(?P<names>[a-z][a-z -]*):(?P<recipe>.*  ## .*\n(?:\t.*\n)*)",
        TEXT,
        re.MULTILINE,
    )
)


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    # Under `make test`, its own variables would make this one a sub-make, which prints more.
    plain = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    plain.pop("MFLAGS", None)
    return subprocess.run(
        ["make", "-n", *arguments],
        cwd=ROOT,
        env=plain,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("collect", "sensor=uskin"), "sensor: unknown; did you mean SENSOR? allowed for collect"),
        (("collect", "TARGET=8"), "TARGET: unknown; did you mean TARGETS?"),
        (("collect", "GPUS=4"), "GPUS: unknown; allowed for collect: SENSOR, TARGETS,"),
        (("resume", "SESSION=x", "SENSOR=uskin"), "SENSOR: unknown; allowed for resume: SESSION,"),
        (("test", "SENSOR=uskin"), "allowed for test: none"),
    ],
)
def test_an_unknown_variable_is_refused(arguments: tuple[str, ...], words: str) -> None:
    ran = make(*arguments)
    assert ran.returncode == 2
    assert words in ran.stderr
    assert ran.stdout == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ("collect", "SENSOR=uskin", "TARGETS=2", "WATCH=0.0.0.0:8765"),
        ("collect", "PYTHON=python3.12"),
        ("check", "test"),
        ("experiment", "ARCHIVE=x", "OUT=y", "ARGS=--pairs a:b"),
    ],
)
def test_known_variables_are_taken(arguments: tuple[str, ...]) -> None:
    assert make(*arguments).returncode == 0


def test_nothing_given_is_dropped() -> None:
    """Which option wins is for the command to say, not for make."""
    both = make("collect", "BENCH=b.yaml", "SENSOR=uskin").stdout
    assert "--bench b.yaml" in both
    assert "--sensor uskin" in both
    assert "--sensor" not in make("collect", "BENCH=b.yaml").stdout
    assert "--watch 0.0.0.0:80" in make("collect", "WATCH=0.0.0.0:80").stdout
    assert "--operator 'Ada L'" in make("collect", "OPERATOR=Ada L").stdout


# Variables of the Makefile itself.
INTERNAL = {"PY", "VENV", "MAKEFILE", "MAKECMDGOALS", "DEMO", "LAUNCH", "GIVEN"}
SHARED = {
    name: set(re.findall(r"\$\(([A-Z_]+)", value)) - INTERNAL
    for name, value in re.findall(r"^([A-Z_]+) *:= (.*)$", TEXT, re.M)
}


@pytest.mark.parametrize("rule", RULES, ids=[rule["names"] for rule in RULES])
def test_the_options_of_a_target_are_the_variables_that_it_reads(rule: re.Match[str]) -> None:
    stated = set(re.findall(r"\b([A-Z_]+)=", rule["options"] or ""))
    read = set(re.findall(r"\$\(([A-Z_]+)", rule["recipe"]))
    while shared := read & set(SHARED):
        read = (read - shared).union(*(SHARED[name] for name in shared))
    assert read - INTERNAL == stated
