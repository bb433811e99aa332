"""numba functions on plain arrays: no objects, no random generator, no checks. Imported only when first needed."""
