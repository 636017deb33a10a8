"""The page of a lab, and forces predicted by a model as a sensor is touched.

`tactile page`, `collect --watch` and `live --page` serve one page with three views: Live, Sessions
and Benches. Nothing on it starts a device.
"""
