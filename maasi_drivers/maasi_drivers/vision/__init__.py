"""From camera images to measurements, and the settings of cameras."""
