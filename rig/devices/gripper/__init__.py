"""The gripper that holds the indenter: driver, emulator, and what tells that the grip is lost."""
