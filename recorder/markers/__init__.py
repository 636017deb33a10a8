"""Binary marker images: packed masks, uSkin discs, counting. What sim, rig and learning share.

An image is 640 x 480. Pixel centres lie at whole numbers, columns run to the right and rows down;
the y axis of a sensor points up, against the rows. A mask is bool (480, 640), True on a marker.
"""

from recorder.markers.blobs import SMALLEST_PX, Blobs, count_markers, find_blobs, marker_centres
from recorder.markers.discs import TAXELS, DiscMap, draw_discs, place_discs
from recorder.markers.displacement import Lattice, moved
from recorder.markers.marker_check import MarkerCheck, MarkerFlag
from recorder.markers.packing import HEIGHT, PACKED, WIDTH, pack, unpack

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
    "unpack",
]
