"""Twins: simulated sensors identified from a real sensor's own presses.

tracks = tracks_of(Session("sessions/x.zarr"))
fit = fitted(tracks, sensor("gelsight"))
fit.sensor, fit.misfit  # a row with its posterior, and how badly it explains the presses
view = viewed(fit, sights_of(tracks, [MarkerArchive("x.markers.zarr")]), name="mine")
view.sensor  # the same with camera and layout of markers
"""

from sim.twin.camera import HeldOut, View, foretold, viewed
from sim.twin.fit import Fit, fitted, misfit
from sim.twin.markers import Sight, sights_of
from sim.twin.model import Model
from sim.twin.observations import Track, track_of, tracks_of

__all__ = [
    "Fit",
    "HeldOut",
    "Model",
    "Sight",
    "Track",
    "View",
    "fitted",
    "foretold",
    "misfit",
    "sights_of",
    "track_of",
    "tracks_of",
    "viewed",
]
