"""Map: a scalar field on a regular grid, its sampling, synthetic fields and the sample DEM."""
