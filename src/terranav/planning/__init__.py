"""Where a fix is possible, and what lies ahead."""
