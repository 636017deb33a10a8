"""Pages from templates: a Markdown or HTML file beside the module that fills it."""

import math
import os
import platform
from pathlib import Path
from typing import Any


def number(value: float | None, form: str = "", missing: str | None = None) -> str:
    """Return a number in a format, or `missing`, if given, for None, NaN and infinity."""
    if missing is not None and (value is None or not math.isfinite(value)):
        return missing
    return format(value, form)


def render(template: Path, **values: Any) -> str:
    """Return the text of a template of Jinja, filled with the values.

    A template may use the filter `number`, and `python`, `cores` and `machine` of this computer. A
    line with a tag alone leaves no line. Texts are escaped if the template's name ends in `.html`.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["number"] = number
    environment.globals |= {
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
    }
    return environment.get_template(template.name).render(values)
