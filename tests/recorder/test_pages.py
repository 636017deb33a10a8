"""Pages from templates: lines of tags, missing values, escaping, and Jinja only when it is used."""

import math
from pathlib import Path

import pytest
from jinja2 import UndefinedError
from support.commands import python

from recorder.pages import number, render


def test_a_template_becomes_the_page_without_its_tags(tmp_path: Path) -> None:
    template = tmp_path / "page.md"
    template.write_text(
        "# {{ title }}\n\n| a | b [N] |\n|---|---:|\n{% for name, value in rows %}\n"
        '| {{ name }} | {{ value | number(".2f", "-") }} |\n{% endfor %}\n\nEnd.\n'
    )
    rows = [("x<y", 1.005), ("z", math.nan)]
    page = "# A & b\n\n| a | b [N] |\n|---|---:|\n| x<y | 1.00 |\n| z | - |\n\nEnd.\n"
    assert render(template, title="A & b", rows=rows) == page


def test_html_is_escaped(tmp_path: Path) -> None:
    template = tmp_path / "page.html"
    template.write_text("<p>{{ text }}</p>\n")
    assert render(template, text="a < b & c") == "<p>a &lt; b &amp; c</p>\n"


def test_a_name_without_a_value_is_an_error(tmp_path: Path) -> None:
    template = tmp_path / "page.md"
    template.write_text("{{ row.width }}")
    with pytest.raises(UndefinedError, match="width"):
        render(template, row={"height": 1.0})


def test_a_number_that_is_missing_is_shown_as_told_or_as_it_is() -> None:
    assert number(1234.5, ",.0f") == "1,234"
    assert number(math.inf, ".1f", "-") == number(None, ".1f", "-") == "-"
    assert number(math.nan, ".1f") == "nan"


def test_jinja_is_imported_when_a_page_is_written() -> None:
    code = "import sys, recorder.pages; assert 'jinja2' not in sys.modules"
    python("-c", code)
