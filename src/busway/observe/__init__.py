"""Observation of links and listeners: traces as log lines, capture files, a dissector of frames, and metrics."""
