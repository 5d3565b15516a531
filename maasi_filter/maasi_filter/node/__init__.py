"""Parts of the filter node."""
