"""Files in and out: rasters, recordings, tables."""
