"""Twins: simulated sensors identified from a real sensor's own presses.

tracks = tracks_of(Session("sessions/x.zarr"))
fit = fitted(tracks, sensor("gelsight"))
fit.sensor, fit.misfit  # a row with its posterior, and how badly it explains the presses
"""

from sim.twin.fit import Fit, fitted, misfit
from sim.twin.model import Model
from sim.twin.observations import Track, track_of, tracks_of

__all__ = ["Fit", "Model", "Track", "fitted", "misfit", "track_of", "tracks_of"]
