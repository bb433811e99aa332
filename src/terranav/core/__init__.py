"""Records, protocols, errors, boundary checks and the WGS-84 earth: what every other package shares."""
