"""Binary marker images: packed masks, uSkin discs and counting, shared by sim, rig and learning.

An image is 640 x 480. Pixel centres are at integer coordinates, columns increase to the right and
rows downwards; a sensor's y axis points up, opposite to the rows. A mask is bool (480, 640), True
on a marker.
"""

from recorder.markers.discs import TAXELS, DiscMap, draw_discs, place_discs
from recorder.markers.displacement import Lattice, moved
from recorder.markers.marker_check import MarkerCheck, MarkerFlag
from recorder.markers.masks import (
    HEIGHT,
    PACKED,
    SMALLEST_PX,
    WIDTH,
    Blobs,
    count_markers,
    find_blobs,
    marker_centres,
    pack,
    smallest_marker,
    unpack,
)

__all__ = [
    "HEIGHT",
    "PACKED",
    "SMALLEST_PX",
    "TAXELS",
    "WIDTH",
    "Blobs",
    "DiscMap",
    "Lattice",
    "MarkerCheck",
    "MarkerFlag",
    "count_markers",
    "draw_discs",
    "find_blobs",
    "marker_centres",
    "moved",
    "pack",
    "place_discs",
    "smallest_marker",
    "unpack",
]
