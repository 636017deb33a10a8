"""Binary marker images: packed masks, uSkin discs and counting, shared by sim, rig and learning.

An image is 640 x 480. Pixel centres are at integer coordinates, columns increase to the right and
rows downwards; a sensor's y axis points up, opposite to the rows. A mask is bool (480, 640), True
on a marker.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from recorder.markers.discs import TAXELS as TAXELS
    from recorder.markers.discs import DiscMap as DiscMap
    from recorder.markers.discs import draw_discs as draw_discs
    from recorder.markers.discs import place_discs as place_discs
    from recorder.markers.displacement import Lattice as Lattice
    from recorder.markers.displacement import moved as moved
    from recorder.markers.marker_check import MarkerCheck as MarkerCheck
    from recorder.markers.marker_check import MarkerFlag as MarkerFlag
    from recorder.markers.masks import HEIGHT as HEIGHT
    from recorder.markers.masks import PACKED as PACKED
    from recorder.markers.masks import SMALLEST_PX as SMALLEST_PX
    from recorder.markers.masks import WIDTH as WIDTH
    from recorder.markers.masks import Blobs as Blobs
    from recorder.markers.masks import count_markers as count_markers
    from recorder.markers.masks import find_blobs as find_blobs
    from recorder.markers.masks import marker_centres as marker_centres
    from recorder.markers.masks import pack as pack
    from recorder.markers.masks import smallest_marker as smallest_marker
    from recorder.markers.masks import unpack as unpack

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
