"""Twins: simulated sensors identified from a real sensor's own presses.

tracks = tracks_of(Session("sessions/x.zarr"))
fit = fitted(tracks, sensor("gelsight"))
fit.sensor, fit.misfit  # a row with its posterior, and how badly it explains the presses
observations = marker_observations(tracks, [MarkerArchive("x.markers.zarr")])
camera_fit = fitted_camera(fit, observations, name="mine")
camera_fit.sensor  # the same with camera and layout of markers
"""

from sim.twin.camera import CameraFit, HeldOut, fitted_camera, held_out_predictions
from sim.twin.fit import Fit, fitted, misfit
from sim.twin.markers import MarkerObservations, marker_observations
from sim.twin.model import TrackModel
from sim.twin.observations import PressTrack, track_of, tracks_of

__all__ = [
    "CameraFit",
    "Fit",
    "HeldOut",
    "MarkerObservations",
    "PressTrack",
    "TrackModel",
    "fitted",
    "fitted_camera",
    "held_out_predictions",
    "marker_observations",
    "misfit",
    "track_of",
    "tracks_of",
]
