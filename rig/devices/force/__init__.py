"""Force and torque: drivers and emulators of ATI sensors on Net F/T and NI DAQ, and of scales."""
