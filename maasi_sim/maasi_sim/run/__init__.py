"""A run: its two missions, processes, supervision, recording, report, and what shows it."""
