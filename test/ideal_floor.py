"""Images without any disturbance but those that a test asks for."""

from maasi_sim.simulation.floor import RenderSettings


def ideal(**changes):
    """Return settings without noise, blur, drift or uneven light, but for the changes given."""
    drifts = ('exposure_drift', 'white_balance_drift', 'light_variation', 'vignetting')
    noises = ('floor_texture', 'shot_noise', 'read_noise', 'exposure_time', 'blur')
    return RenderSettings.model_validate(dict.fromkeys((*drifts, *noises), 0.0) | changes)
