"""Force and torque: drivers and emulators of ATI sensors on Net F/T, NI DAQ and RS-232."""
