"""The Makefile hands variables over whole, and refuses names that nothing reads."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.make_names import variables_of

from tactile.commands import COMMANDS

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "Makefile").read_text()
# Target, and its line in the list.
TARGETS = dict(re.findall(r"^([a-z-]+):.*  ## (.*)$", TEXT, re.MULTILINE))


def make(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    # Under `make test`, its own variables would make this one a sub-make, which prints more.
    plain = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    plain.pop("MFLAGS", None)
    return subprocess.run(
        ["make", *arguments],
        cwd=ROOT,
        # Its search for a Python that fits takes most of the time.
        env={"PYTHON": sys.executable} | plain | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_it_is_short() -> None:
    lines = TEXT.splitlines()
    assert len(lines) <= 120
    assert max(map(len, lines)) <= 110


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("collect", "sensor=uskin"), "sensor: unknown; did you mean SENSOR? allowed: ARGS, BENCH"),
        (("collect", "TARGET=8"), "TARGET: unknown; did you mean TARGETS?"),
        (("collect", "GPUS=4"), "GPUS: unknown; allowed: ARGS, BENCH, FORCE"),
        (("resume", "SESSION=x", "SENSOR=uskin"), "SENSOR: unknown; "),
        (("docs", "SENSOR=uskin"), "allowed: SERVE"),
        (("test", "SENSOR=uskin"), "allowed: none"),
        (("collect", "SENSOR=tacplam"), "SENSOR=tacplam: unknown; did you mean tacpalm? known: "),
        (("collect", "TARGET=8", "PYTHON=nothing"), "found nothing, which does not run; allowed: "),
        (("campaign", "FILE=campaigns/dya.yaml"), "did you mean campaigns/day.yaml?"),
    ],
)
def test_an_unknown_name_is_refused_before_anything_is_installed(
    arguments: tuple[str, ...], words: str
) -> None:
    ran = make("-n", *arguments)
    assert ran.returncode == 2
    assert f"wrong input: {arguments[-1].partition('=')[0]}" in ran.stderr
    assert words in ran.stderr
    assert ran.stdout == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ("collect", "SENSOR=uskin", "TARGETS=2", "ARGS=--watch 0.0.0.0:8765"),
        ("collect", "PYTHON=python3", "SENSOR=uskin"),
        ("check", "test"),
        ("campaign", "FILE=campaigns/day.yaml"),
        ("campaign", "FILE=rig/bench/campaigns/day.yaml"),
        ("demo-learning", "OUT=runs/here"),
    ],
)
def test_known_names_are_accepted(arguments: tuple[str, ...]) -> None:
    assert make("-n", *arguments).returncode == 0


def test_values_are_handed_over_whole() -> None:
    """Which option wins is for the command to say, not for make."""
    both = make("-n", "collect", "BENCH=my own.yaml", "SENSOR=uskin").stdout
    assert "--bench 'my own.yaml'" in both
    assert "--sensor 'uskin'" in both
    assert r"--operator 'O'\''Hara'" in make("-n", "collect", "OPERATOR=O'Hara").stdout
    assert "--operator '$HOME; `id`'" in make("-n", "collect", "OPERATOR=$HOME; `id`").stdout
    resumed = make("-n", "resume", "SESSION=a b.zarr", "AGAIN=3,7").stdout
    assert "--resume 'a b.zarr' --again '3,7'" in resumed
    assert "out='my runs'" in make("-n", "demo-transfer", "OUT=my runs").stdout
    more = make("-n", "collect", "SENSOR=uskin", "ARGS=--still").stdout
    assert "collect --sensor 'uskin' --still" in " ".join(more.split())


def test_the_environment_gives_no_options() -> None:
    plain = make("-n", "collect", "SENSOR=uskin").stdout
    others = {"OPERATOR": "me", "ARGS": "--still", "HOST": "x"}
    assert make("-n", "collect", "SENSOR=uskin", **others).stdout == plain
    assert "serve" not in make("-n", "docs", SERVE="1").stdout


def test_all_targets_are_listed_with_variables_that_they_read() -> None:
    (phony,) = re.findall(r"^\.PHONY: ((?:.*\\\n)*.*)$", TEXT, re.MULTILINE)
    assert {*TARGETS, "help"} == set(phony.replace("\\", " ").split())
    for target, line in TARGETS.items():
        read = variables_of(target, TEXT)
        assert read is not None
        assert set(re.findall(r"\b([A-Z]+)=", line)) <= read


def test_make_lists_its_targets_in_groups_of_short_lines() -> None:
    listed = make("--no-print-directory").stdout.splitlines()
    assert max(map(len, listed)) < 100
    assert [line.split()[0] for line in listed if line.startswith("  ")] == list(TARGETS)
    groups = [line.split()[0] for line in listed[1:] if line[:1].strip()]
    assert groups == ["Record", "Demos", "Develop"]


def test_its_commands_exist() -> None:
    run = re.findall(r"\$\(TACTILE\) ([a-z-]+)(?: ([a-z-]+))?", TEXT)
    assert run
    assert all(first in COMMANDS or f"{first} {second}" in COMMANDS for first, second in run)
