"""Runs of scenarios: processes, recording, observation, report and replay."""
