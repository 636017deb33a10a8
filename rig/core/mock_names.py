"""Names by which the processes of a mock bench reach one another."""

# Records in a run folder: motion of the arm, states of the World, motion of a hand, and the records
# of a simulated World. The state of a hand's finger is in `<finger>.state`.
ARM_FILE, WORLD_FILE = "arm.state", "world.state"
HAND_FILE = "hand.state"
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
