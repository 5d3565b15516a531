"""An autopilot that speaks MAVLink 2, and the vehicle that it moves."""
