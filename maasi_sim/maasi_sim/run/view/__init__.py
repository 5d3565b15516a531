"""The view of a search: events of a run, the page that shows them, live or as a replay."""
