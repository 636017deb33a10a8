"""The UR arm: driver, its process, and an emulated controller."""
