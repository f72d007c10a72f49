"""The peers' servers and clients: run by the interpreter of their own environment (`.peers/`), never imported."""
