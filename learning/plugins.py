"""Models of other packages: translators and force models, by entry points of `tactile.models`.

A package that offers one says so in its `pyproject.toml`:

    [project.entry-points."tactile.models"]
    mine = "my_package:load"

`load(folder, device)` returns the model. `folder` is None if it was named (`--model mine`), else a
folder whose `config.yaml` has `kind: mine`.
"""

from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from learning.errors import LearningError

GROUP = "tactile.models"


def plugin_names() -> tuple[str, ...]:
    """Return the names of the models that installed packages offer, in alphabetical order."""
    return tuple(sorted(entry_points(group=GROUP).names))


def plugin_identity(name: str) -> str:
    """Return a model's name with name and version of its package: its identity without a folder."""
    package = _entry_point(name).dist
    return name if package is None else f"{name} of {package.name} {package.version}"


def load_plugin(
    name: str, interface: type[Any], *, folder: Path | None = None, device: str = "cpu"
) -> Any:
    """Return a model of another package, an `interface`, by its entry point's name and folder."""
    entry = _entry_point(name)
    try:
        load = entry.load()
    except (ImportError, AttributeError) as error:
        raise LearningError(f"model {name!r}: cannot import {entry.value}: {error}") from error
    model = load(folder, device)
    if not isinstance(model, interface):
        raise LearningError(
            f"model {name!r}: {entry.value} returned {type(model).__name__}; allowed: a "
            f"{interface.__name__}"
        )
    return model


def _entry_point(name: str) -> EntryPoint:
    offered = list(entry_points(group=GROUP, name=name))
    if not offered:
        names = ", ".join(plugin_names()) or "none is installed"
        raise LearningError(f"model: found {name!r}; offered by installed packages: {names}")
    if len({each.value for each in offered}) > 1:
        several = ", ".join(sorted(each.value for each in offered))
        raise LearningError(f"model {name!r}: found {several}; allowed: one package that offers it")
    return offered[0]
