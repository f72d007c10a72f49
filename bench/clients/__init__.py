"""Our clients as programs: each measures for a given time and prints one line of JSON."""
