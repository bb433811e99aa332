"""The commands of `terranav`, one module each. Nothing heavy is imported before a command runs: --help stays fast."""
