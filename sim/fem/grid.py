"""Who is next to whom on the regular grid of nodes: slots of the 27-point stencil, colours.

A slot is a step (di, dj, dk) of the grid, each -1, 0 or 1: s = 9 (di + 1) + 3 (dj + 1) + dk + 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.fem.mesh import Mesh

SLOTS = 27
CENTRE = 13
"""Slot of a node itself."""


def slot_offsets(cells: tuple[int, int, int]) -> NDArray[np.int64]:
    """Node number of each slot's neighbour less the node's own (27,)."""
    plane, row = (cells[1] + 1) * (cells[2] + 1), cells[2] + 1
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets: NDArray[np.int64] = steps @ np.array([plane, row, 1])
    return offsets


def neighbours(cells: tuple[int, int, int]) -> NDArray[np.int64]:
    """Node of each slot (N, 27); -1 where the grid ends."""
    shape = np.array(cells) + 1
    place = np.stack(np.unravel_index(np.arange(shape.prod()), shape), axis=-1)
    steps = np.stack(np.unravel_index(np.arange(SLOTS), (3, 3, 3)), axis=-1) - 1
    there = place[:, None] + steps
    inside = ((there >= 0) & (there < shape)).all(axis=-1)
    return np.where(inside, np.arange(shape.prod())[:, None] + slot_offsets(cells), -1)


def face_slots(mesh: Mesh) -> NDArray[np.int64]:
    """Slot of corner b of a face as seen from its corner a (S, 4, 4)."""
    difference = mesh.faces[:, None, :] - mesh.faces[:, :, None]
    offsets = slot_offsets(mesh.cells)
    slots: NDArray[np.int64] = np.argmax(difference[..., None] == offsets, axis=-1)
    return slots


def colour_order(cells: tuple[int, int, int]) -> tuple[NDArray[np.int64], list[int]]:
    """Elements by colour, no two of a colour sharing a node (E,), and where colours begin (9,)."""
    place = np.stack(np.unravel_index(np.arange(np.prod(cells)), cells), axis=-1) % 2
    colour = place @ np.array([4, 2, 1])
    begins = np.searchsorted(np.sort(colour), np.arange(9))
    return np.argsort(colour, kind="stable"), begins.tolist()
