"""Readers of logs: `open_log(path)` gives a recording, the facts of the log, and remarks on it.

One module a format (dataflash, tlog, ulog, rosbag, nmea, phone); each returns what it found (`found.Found`), and
`assembly` makes the recording. The libraries that decode the formats are the extra 'logs'.
"""

from terranav.io.logs.assembly import Log
from terranav.io.logs.opening import open_log

__all__ = ["Log", "open_log"]
