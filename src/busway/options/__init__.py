"""Options: endpoints as URLs, options as text or keywords, and presets of options. Pure."""
