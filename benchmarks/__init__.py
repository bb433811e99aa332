"""Speed as ratios to named peers, measured in one process on the same input after checking that the answers agree."""
