"""Regression test: the commands' output and files match the golden records (see README.md)."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

# The scripts of this folder also run on their own.
sys.path.insert(0, str(Path(__file__).parent))

from cases import CASES
from golden import CHECKOUT, Case
from replay import replayed


def _marks(case: Case) -> list[pytest.MarkDecorator]:
    timeout = pytest.mark.timeout(case.timeout * (1 if case.one_process else len(case.commands)))
    return [timeout, pytest.mark.slow] if case.slow else [timeout]


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.name, marks=_marks(case)) for case in CASES]
)
def test_it_is_as_it_was(case: Case) -> None:
    lines, _note, _took = replayed(case, CHECKOUT)
    assert not lines, "\n".join(lines)
