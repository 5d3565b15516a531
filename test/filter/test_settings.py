"""Settings: what is refused, and what the presets fill in."""

import numpy as np
import pytest
from pydantic import ValidationError

from maasi_filter import (
    DetectionSettings,
    EnvironmentSettings,
    FilterSettings,
    NoiseSettings,
    SensorSettings,
)
from maasi_filter.settings import unsuitable_lengths, unused_settings


@pytest.mark.parametrize(
    ('model', 'values', 'word'),
    [
        (FilterSettings, {'particels': 5}, 'particels'),
        (FilterSettings, {'preset': 'paper_005'}, 'preset'),
        (FilterSettings, {'preset': 'recommended'}, 'method: pmb'),
        (FilterSettings, {'found_radius': float('nan')}, 'found_radius'),
        (DetectionSettings, {'size': [25.0]}, 'size'),
        (DetectionSettings, {'lower': [0.3, -0.2]}, 'lower'),
        (DetectionSettings, {'lower': [-0.2, -0.2, -0.2]}, 'each'),
        (EnvironmentSettings, {'bounds': [[0.0, 1.0]]}, 'bounds'),
        (EnvironmentSettings, {'bounds': [[0.0, 1.0], [1.0, 1.0]]}, 'bounds'),
        (EnvironmentSettings, {'bounds': [[0.0, 1.0], [0.0, float('inf')]]}, 'bounds'),
    ],
)
def test_wrong_settings_are_refused_by_name(model, values, word):
    with pytest.raises(ValidationError, match=word):
        model(**values)


def test_presets_fill_in_what_is_not_given():
    settings = FilterSettings(preset='paper_001', found_mass=0.9).resolved()
    assert settings.particles == 5000
    assert settings.found_mass == 0.9
    assert settings.removal == 'closest'
    assert FilterSettings(preset='paper_001', particles=777).resolved().particles == 777
    assert FilterSettings().resolved().particles == 10_000
    assert SensorSettings().resolution > 0.0
    # The other filter derives its lengths from the sensor.
    assert FilterSettings(method='pmb').resolved().found_radius is None


def test_three_dimensional_noise_needs_an_elevation():
    noise = NoiseSettings(range=0.016, bearing=0.052, elevation=0.0)
    assert noise.covariance(2).shape == (2, 2)
    with pytest.raises(ValueError, match='elevation'):
        noise.covariance(3)


def test_settings_that_only_the_other_method_has_are_warned_of():
    assert unused_settings(FilterSettings(particles=500, removal_distance=1.0)) == ''
    assert unused_settings(FilterSettings(method='pmb', pmb={'walk': 0.1}, pose_error=0.1)) == ''
    told = unused_settings(FilterSettings(pmb={'walk': 0.1}, pose_error=0.1))
    assert told.startswith('filter: pose_error, pmb: only for method pmb')
    told = unused_settings(FilterSettings(method='pmb', preset='paper_001', jitter_deviation=0.1))
    assert told.startswith('filter: preset, jitter_deviation: only for method ic_phd')


def test_lengths_that_do_not_suit_an_environment_are_warned_of():
    floor, cube = np.array([[0.0, 2.7]] * 2), np.array([[0.0, 260.0]] * 3)
    assert 'T_z is 5 m, in an environment of 2.7 m' in unsuitable_lengths(FilterSettings(), floor)
    assert unsuitable_lengths(FilterSettings(), cube) == ''
    assert unsuitable_lengths(FilterSettings(method='pmb'), floor) == ''
    assert unsuitable_lengths(FilterSettings(removal_distance=0.05), floor) == ''
