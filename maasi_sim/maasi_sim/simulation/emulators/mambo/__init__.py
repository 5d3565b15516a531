"""A Parrot Mambo: its firmware, its body, and its WiFi protocol."""
