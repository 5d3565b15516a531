"""The objective of a decision: what a joint candidate of the team is worth (000, section 4.2)."""
