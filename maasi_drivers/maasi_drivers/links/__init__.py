"""The wires to robots: topics, Parrot Mambo, MAVLink."""
