"""A recorded session played back through mock hardware: emulators send it, drivers record it."""
