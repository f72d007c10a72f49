"""What happens on links and listeners, made visible: log lines, and later metrics and captures."""
