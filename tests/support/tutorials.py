"""Tutorials, as pages whose blocks of code can be run in order."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return the blocks of code of a page in order, each with its kind."""
    return [(kind or "text", code) for kind, code in _BLOCK.findall(page.read_text())]
