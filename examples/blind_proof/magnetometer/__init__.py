"""The blind proof of the magnetometer: recordings of a sensor that shares no code with the catalogue."""
