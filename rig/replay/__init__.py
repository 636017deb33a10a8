"""Playback of a recorded session through emulators, recorded again by the real drivers."""
