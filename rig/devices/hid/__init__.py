"""Devices of USB class HID: the foot pedal and the SpaceMouse, with their emulator."""
