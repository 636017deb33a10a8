"""Size of the solver's state for an effect, counted and as declared."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.sim.effects.declaration import Memory


def stored(state: Any, memory: Memory) -> int:
    """Return how many numbers the state has in an effect's array; 0 without an array."""
    array = state
    for name in memory.name.split("."):
        array = getattr(array, name)
        if array is None:
            return 0
    return int(np.size(array if isinstance(array, np.ndarray) else array.numpy()))


def declared(assembly: Any, memory: Memory, branches: int = 1) -> int:
    """Return how many numbers an effect declares, with at most `branches` Prony branches."""
    mesh = assembly.mesh
    elements = len(mesh.elements)
    places = {
        "environment": 1,
        "node": len(mesh.nodes),
        "element": elements,
        "Gauss point": elements * mesh.weight.shape[1],
        "contact point": len(mesh.faces) * assembly.points,
        "branch and element": branches * elements,
        "branch and Gauss point": branches * elements * mesh.weight.shape[1],
    }
    return int(assembly.environments * places[memory.per] * memory.numbers)
