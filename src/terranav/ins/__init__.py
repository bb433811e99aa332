"""INS grades, drift, and flight simulation on the python-ins package."""
