"""Observation of links and listeners: log lines, capture files, the dissector, metrics."""
