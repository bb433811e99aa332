"""Recursive methods, one a file: the module name is the method's name everywhere; leading underscores mark helpers."""
