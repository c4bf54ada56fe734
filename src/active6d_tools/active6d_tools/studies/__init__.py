"""Studies behind design decisions; each module is a command with `--help`."""
