"""Tables that stand in for the march: constant time per look-up, filled from a solved :class:`atmo_jit.sky.Sky`."""
