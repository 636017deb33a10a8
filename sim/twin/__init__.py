"""Twins: simulated sensors identified from a real sensor's own presses.

tracks = tracks_of(Session("sessions/x.zarr"))
fit = fitted(tracks, sensor("gelsight"))
fit.sensor, fit.misfit  # a row with its posterior, and how badly it explains the presses
observations = marker_observations(tracks, [MarkerArchive("x.markers.zarr")])
camera_fit = fitted_camera(fit, observations, name="mine")
camera_fit.sensor  # the same with camera and layout of markers
"""

from sim.twin.camera import CameraFit as CameraFit
from sim.twin.camera import HeldOut as HeldOut
from sim.twin.camera import fitted_camera as fitted_camera
from sim.twin.camera import held_out_predictions as held_out_predictions
from sim.twin.fit import Fit as Fit
from sim.twin.fit import fitted as fitted
from sim.twin.fit import misfit as misfit
from sim.twin.gaugeless import GaugelessFit as GaugelessFit
from sim.twin.gaugeless import MarkedPress as MarkedPress
from sim.twin.gaugeless import fitted_without_gauge as fitted_without_gauge
from sim.twin.gaugeless import marked_presses as marked_presses
from sim.twin.gaugeless import weighed_press as weighed_press
from sim.twin.markers import MarkerObservations as MarkerObservations
from sim.twin.markers import marker_observations as marker_observations
from sim.twin.model import TrackModel as TrackModel
from sim.twin.observations import PressTrack as PressTrack
from sim.twin.observations import track_of as track_of
from sim.twin.observations import tracks_of as tracks_of
