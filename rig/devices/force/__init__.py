"""Force and torque: the ATI Net F/T box, its driver and its emulator."""
