"""The gripper that holds the indenter: driver, emulator, and detection of a lost grip."""
