"""Speed as ratios to named peers, measured in one process on the same input after checking that the answers agree.

Each module with a function rows() is one benchmark; the others are studies of accuracy that take minutes.
"""

import os

for _library in ("OPENBLAS", "OMP", "MKL"):  # one thread for everyone; counts only before numpy is loaded
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
