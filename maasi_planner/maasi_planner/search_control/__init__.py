"""Starting, pausing, resuming and ending a search: its action, services and modes."""
