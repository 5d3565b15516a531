"""Links to robots: topics, Parrot Mambo, MAVLink."""
