"""Names by which the processes of a mock bench reach one another."""

# Records in a run folder: the arm's motion, the World's states, and those of a simulated World.
ARM_FILE, WORLD_FILE = "arm.state", "world.state"
PRESS_FILE, SURFACE_FILE = "press.state", "surface.state"

# Fault port of each device of a mock bench, at the bench's loopback address.
PORTS = {
    "arm": 31000,
    "force": 31001,
    "camera": 31002,
    "taxels": 31003,
    "gripper": 31004,
    "pedal": 31005,
    "spacemouse": 31006,
    "world": 31007,
}
