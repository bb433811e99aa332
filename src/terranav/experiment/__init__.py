"""Scenario, stream, run, result, metrics: one loop for simulated, recorded and live epochs."""
