"""Sensor error models, and raw readings turned into measurements."""
