"""The page of a search: its events, live or as a replay."""
