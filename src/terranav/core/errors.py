"""The three exceptions and the one warning of terranav.

Messages name the file, the key, the value seen and what was expected, in one line.
"""


class TerranavError(Exception):
    """Base of every error that terranav raises on purpose; the CLI prints it and exits with status 2."""


class DataError(TerranavError, ValueError):
    """A file or an array is not what it should be (missing, truncated, out of range, no coordinates...)."""


class ConfigError(TerranavError, ValueError):
    """A setting, a scenario key or an argument is unknown or has an impossible value."""


class StateError(TerranavError, RuntimeError):
    """Something was asked in a state that cannot give it (metrics without truth, an unfinished run...)."""


class DataWarning(UserWarning):
    """The data can be used, but something about it is suspicious or was assumed."""
