"""Our servers as programs: each tells its port and runs until it is ended."""
