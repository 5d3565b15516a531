"""Hill shading of terrain on the page: lit from the north-west, whatever the ground."""

import base64

import cv2
import numpy as np
import pytest

from maasi_filter.geometry.terrain import Terrain
from maasi_sim.run.view.scene import scene_of
from maasi_sim.scenario.background import background_of
from maasi_sim.scenario.hill_shading import hill_shading
from maasi_sim.scenario.loading import load_scenario

LOW, HIGH = np.array([0.0, 0.0]), np.array([300.0, 200.0])


def brightness(pixels):
    """Return white as positive and black as negative opacity."""
    signed = pixels.astype(float)
    return np.where(signed[..., 0] > 0.0, signed[..., 3], -signed[..., 3])


@pytest.mark.parametrize('seed', range(8))
def test_a_plane_has_the_shade_of_its_side(seed):
    generator = np.random.default_rng(seed)
    along = generator.uniform(0.0, 2.0 * np.pi)
    x, y = np.meshgrid(np.linspace(-10, 310, 33), np.linspace(-10, 210, 23), indexing='ij')
    # It descends towards `along`; its slope is drawn as it is.
    ground = -0.8 * (x * np.cos(along) + y * np.sin(along))
    shown = hill_shading(Terrain(ground, [-10.0, -10.0], [10.0, 10.0]), LOW, HIGH)
    assert shown.shape == (367, 550, 4)
    assert np.ptp(shown.astype(int), axis=(0, 1)).max() <= 1
    towards_light = np.cos(along - 0.75 * np.pi)
    # n times l, relative to that of level ground.
    expected = (1.0 + 0.8 * towards_light) / np.hypot(1.0, 0.8) - 1.0
    assert brightness(shown).mean() == pytest.approx(150.0 * expected, abs=1.0)


def test_level_ground_is_transparent_and_gentle_hills_are_visible():
    level = hill_shading(Terrain(np.full((4, 4), 7.0), LOW, [100.0, 100.0]), LOW, HIGH)
    assert not level.any()
    x = np.linspace(-10.0, 310.0, 65)
    heights = np.outer(0.05 * np.minimum(x, 300.0 - x), np.ones(5))
    ridge = Terrain(heights, LOW - [10.0, 100.0], [5.0, 100.0])
    shades = brightness(hill_shading(ridge, LOW, HIGH))
    assert shades[:, :270].min() > 15.0
    assert shades[:, 280:].max() < -15.0


def test_the_page_has_it_below_the_map_unless_there_is_a_picture():
    scenario = load_scenario('hills')
    data, bounds = scene_of('one', scenario)['background']
    low, high = np.array(bounds).T
    assert (low < scenario.environment.array()[:, 0]).all()
    assert (high > scenario.environment.array()[:, 1]).all()
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape[2] == 4 and len(data) < 150_000
    # The middle of the north-west side of each hill is lighter than that of its south-east side.
    shades = brightness(picture)
    terrain = scenario.world(1).area.terrain
    x, y = (np.linspace(a, b, 60) for a, b in zip(low, high))
    points = np.stack(np.meshgrid(x, y, indexing='ij'), axis=-1).reshape(-1, 2)
    inside = ((points > low + 5.0) & (points < high - 5.0)).all(axis=1)
    points = points[inside]
    slopes = terrain.slopes(points)
    column = ((points[:, 0] - low[0]) / (high - low)[0] * picture.shape[1]).astype(int)
    row = ((high[1] - points[:, 1]) / (high - low)[1] * picture.shape[0]).astype(int)
    lit = slopes[:, 0] - slopes[:, 1]
    steep = np.abs(lit) > 0.1
    assert np.corrcoef(lit[steep], shades[row[steep], column[steep]])[0, 1] > 0.8
    flat = scenario.environment.model_copy(update={'terrain': type(scenario.environment.terrain)()})
    assert background_of(flat) is None
