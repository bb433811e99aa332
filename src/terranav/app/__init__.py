"""The faces: command line, report, pictures, notebook."""
