"""The `mpm` tier compared with finite elements."""
