"""Check names of variables, sensors and campaigns after `make`, before anything is installed.

    python tests/support/make_names.py 'collect' 'SENSOR=tacplam'

Prints one line if a name is unknown, with the nearest that is known; nothing if all are known.
"""

import re
import sys
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Variables of the Makefile itself, which any target takes.
GENERAL = {"PYTHON", "VENV"}


def variables_of(target: str, makefile: str) -> set[str] | None:
    """Return the variables that the recipe of a target reads; None: there is no such target."""
    rule = re.search(rf"^{re.escape(target)}:.*\n(?:\t.*\n)*", makefile, re.MULTILINE)
    if rule is None:
        return None
    names = set(re.findall(r"\$\(call given,([A-Z]+)\)", rule[0]))
    for listed in re.findall(r"\$\(call options,?([A-Z ]*)\)", rule[0]):
        names |= {*listed.split(), "ARGS"}
    return names | ({"OUT"} if "$(call folder," in rule[0] else set())


def wrong_name(targets: Iterable[str], given: dict[str, str]) -> str:
    """Return a line about the first name that is unknown; empty if all are known."""
    makefile = (ROOT / "Makefile").read_text()
    read = [names for each in targets if (names := variables_of(each, makefile)) is not None]
    if not read:
        return ""
    allowed = set().union(*read)
    for name in given:
        if name not in allowed | GENERAL:
            listed = ", ".join(sorted(allowed)) or "none"
            return f"{name}: unknown; {near(name.upper(), allowed)}allowed: {listed}"
    for name, folders in (("SENSOR", "benches"), ("FILE", "campaigns")):
        if name not in given:
            continue
        text = given[name]
        files = [file for place in places(folders) for file in sorted(place.glob("*.yaml"))]
        if name == "SENSOR":
            known = {file.stem for file in files} - {"mock"}
        elif Path(text).exists():
            continue
        else:
            known = {f"campaigns/{file.name}" for file in files}
        if text not in known:
            listed = ", ".join(sorted(known))
            return f"{name}={text}: unknown; {near(text, known)}known: {listed}"
    return ""


def places(folder: str) -> list[Path]:
    """Return the folders that may hold a lab's files and those of the package."""
    return [Path(folder) / "lab", Path(folder), ROOT / "rig" / "bench" / folder]


def near(name: str, known: Iterable[str]) -> str:
    """Return a question with the nearest known name; empty if none is near."""
    matches = get_close_matches(name, sorted(known), n=1)
    return f"did you mean {matches[0]}? " if matches else ""


if __name__ == "__main__":
    goals, *typed = sys.argv[1:]
    print(wrong_name(goals.split(), dict(each.split("=", 1) for each in typed)), end="")
