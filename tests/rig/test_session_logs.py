"""Log files of sessions, also of those that are recorded within another."""

import logging
from pathlib import Path

import pytest

from rig.cli.options import logged_to


def test_each_session_has_its_messages_in_its_own_file_and_the_outer_one_has_all(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    handlers = list(logging.getLogger().handlers)
    whole, first, second = (tmp_path / name for name in ("whole", "first", "second"))
    for session in (whole, first, second):
        session.mkdir()
    with logged_to(whole):
        for path in (first, second):
            with logged_to(path):
                logging.info("in %s", path.name)
        with logged_to(whole):
            logging.info("at the end")
    logging.info("after")
    lines = {
        path: path.with_suffix(".log").read_text().splitlines() for path in (whole, first, second)
    }
    assert [line.partition("root: ")[2] for line in lines[first]] == ["in first"]
    assert [line.partition("root: ")[2] for line in lines[second]] == ["in second"]
    messages = [line.partition("root: ")[2] for line in lines[whole]]
    assert messages == ["in first", "in second", "at the end"]
    assert logging.getLogger().handlers == handlers
    whole.rmdir()
    with logged_to(whole):
        logging.info("nothing was recorded")
    assert not whole.with_suffix(".log").exists()
