"""Talking to devices: links, the pool that shares them, the asynchronous and the blocking interface."""
