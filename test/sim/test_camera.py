"""The rendered camera."""

import numpy as np
import pytest
from ideal_floor import ideal
from numpy.testing import assert_allclose, assert_array_equal
from pydantic import ValidationError

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.pose import Pose, quaternion_product
from maasi_sim.simulation.camera import CameraRenderer
from maasi_sim.simulation.floor import RenderSettings, disc, draw_distractors, scene_of
from maasi_sim.simulation.world import TargetSettings, World, noise_stream

IDEAL = ideal()
DOWN = Pose.from_yaw([0.0, 0.0, 1.0], 0.0)
_RATIONAL = 'rational_polynomial'
MARKER = [0.08, 0.17, 0.62]


def camera(**changes):
    return Camera.from_settings(CameraSettings.model_validate(changes))


def renderer(shapes, settings=IDEAL, view=None, seed=1, robot='drone'):
    return CameraRenderer(view or camera(), settings, shapes, seed, robot)


def coverage(image):
    """How much of each pixel is marker, from its red channel."""
    floor, marker = 255 * 0.47, 255 * MARKER[0]
    return (floor - image[..., 0].astype(float)) / (floor - marker)


def centroid(image):
    weights = np.where(coverage(image) > 0.02, coverage(image), 0.0)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize(
    'changes',
    [
        {},
        {'distortion': [-0.25, 0.08, 0.003, -0.002, 0.0]},
        {'distortion': [0.4, -0.3, 0, 0, 0.1, 0.2, 0.1, 0], 'distortion_model': _RATIONAL},
        {'distortion': [0.1, 0.02, 0, 0], 'distortion_model': 'equidistant'},
        {'mount': {'position': [0.02, 0.01, -0.05], 'rpy': [0.1, 1.3, 0.4]}},
        {'width': 320, 'height': 240, 'focal_length': [500, 520]},
    ],
)
def test_a_marker_appears_where_the_projection_says(changes, seed):
    generator = np.random.default_rng(seed)
    view = camera(**changes)
    tilt = generator.normal(0.0, 0.05, 2)
    pose = Pose(
        np.array([*generator.uniform(-1, 1, 2), 1.0]), np.array([1.0, *tilt, generator.normal()])
    )
    pixel = generator.uniform(0.2, 0.8, 2) * [view.width, view.height]
    centre = view.back_project([pixel], pose)[0][0]
    image = renderer([disc(centre, 0.015, MARKER)], view=view).render(pose, 0, 0.0)
    assert_allclose(centroid(image), pixel, atol=0.08)


@pytest.mark.parametrize(
    ('focal', 'pixel', 'share'),
    [(150.0, (82.0, 57.0), 1.0), (520.0, (82.0, 57.0), 1.0), (260.0, (-0.5, 59.5), 0.5)],
)
def test_a_marker_covers_its_area_up_to_the_border(focal, pixel, share):
    view = camera(focal_length=[focal, focal])
    place = view.back_project([pixel], DOWN)[0][0]
    image = renderer([disc(place, 0.015, MARKER)], view=view).render(DOWN, 0, 0.0)
    seen = coverage(image)[coverage(image) > 0.02].sum()
    assert_allclose(seen, share * np.pi * (0.015 * focal) ** 2, rtol=0.05)
    assert coverage(image)[round(pixel[1]), max(round(pixel[0]), 0)] > 0.95


def test_markers_are_seen_only_from_above_and_below_the_horizon():
    view = camera(mount={'position': [0.0, 0.0, 0.2], 'rpy': [0.0, 0.0, 0.0]})
    image = renderer([disc([1.5, 0.0], 0.3, MARKER)], view=view).render(Pose([0, 0, 0]), 0, 0.0)
    assert (coverage(image)[:59] < 0.02).all()
    assert coverage(image)[60:].max() > 0.9
    under = renderer([disc([0.0, 0.0], 0.3, MARKER)]).render(
        Pose([0.0, 0.0, -1.0]), 0, 0.0, (1.0, 0.0, 0.0)
    )
    assert (coverage(under) < 0.02).all()


def test_what_lies_on_top_hides_what_lies_below():
    shapes = [disc([0, 0], 0.05, [1.0, 0.0, 0.0]), disc([0, 0], 0.02, [0.0, 1.0, 0.0])]
    image = renderer(shapes).render(DOWN, 0, 0.0)
    assert_array_equal(image[59, [79, 89]], [[0, 255, 0], [255, 0, 0]])


@pytest.mark.parametrize(
    ('velocity', 'rate'),
    [
        ((0.6, -0.5, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 1.5), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.8, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 6.0)),
        ((0.5, 0.4, -0.5), (0.3, 0.6, 3.0)),
    ],
)
def test_motion_blur_is_the_mean_of_the_images_along_the_way(velocity, rate):
    exposure = 0.05
    shapes = [disc([0.05, 0.12], 0.02, MARKER)]
    middle = Pose(np.array([0.01, 0.02, 1.0]), np.array([1.0, 0.02, -0.03, 0.3]))
    blurred = renderer(shapes, ideal(exposure_time=exposure)).render(middle, 0, 0.0, velocity, rate)
    sharp = renderer(shapes)
    images = []
    for time in (np.arange(40) + 0.5) / 40 * exposure - 0.5 * exposure:
        turn = 0.5 * time * np.array(rate)
        orientation = quaternion_product(middle.orientation, [1.0, *turn])
        pose = Pose(middle.position + time * np.array(velocity), orientation)
        images.append(coverage(sharp.render(pose, 0, 0.0)))
    assert np.abs(coverage(blurred) - np.mean(images, axis=0)).max() < 0.08
    assert np.abs(coverage(blurred) - coverage(sharp.render(middle, 0, 0.0))).max() > 0.12


def test_noise_has_the_deviation_that_is_set_and_is_keyed():
    settings = ideal(read_noise=3.0, shot_noise=0.1)
    one = renderer([], settings)
    image = one.render(DOWN, 5, 0.0)
    assert_allclose(image.std(axis=(0, 1)), np.sqrt(9 + 0.1 * 120), rtol=0.03)
    assert_allclose(image.mean(axis=(0, 1)), [119.85, 119.85, 117.3], atol=0.2)
    for changes, step in (({}, 6), ({'seed': 2}, 5), ({'robot': 'other'}, 5)):
        other = renderer([], settings, **changes).render(DOWN, step, 0.0)
        both = np.stack([image[..., 0].ravel(), other[..., 0].ravel()]).astype(float)
        assert abs(np.corrcoef(both)[0, 1]) < 0.02
    # The order of rendering does not matter, with disturbances of all kinds.
    shapes = [disc([0.1, 0.0], 0.015, MARKER)]
    first, second = (renderer(shapes, RenderSettings()) for _ in range(2))
    second.render(Pose.from_yaw([0.5, 0.5, 1.2], 1.0), 2, 0.2)
    assert_array_equal(second.render(DOWN, 1, 0.1), first.render(DOWN, 1, 0.1))


def test_light_vignetting_and_drift_change_brightness_as_set():
    light = renderer([], ideal(light_variation=0.4, light_wavelength=0.4))
    image = light.render(DOWN, 0, 0.0)[..., 0]
    assert_allclose([image.max(), image.min()], [120 * 1.4, 120 * 0.6], atol=4)
    corner = renderer([], ideal(vignetting=0.5)).render(DOWN, 0, 0.0)[0, 0, 0]
    assert_allclose(corner, 60, atol=2)
    drifting = renderer([], ideal(white_balance_drift=0.2, exposure_drift=0.1))
    gains = np.array([drifting.gains(time) for time in np.linspace(0, 100, 400)])
    assert_allclose(np.ptp(gains, axis=0), 0.5, atol=0.12)
    assert gains.min() >= 0.9 * 0.8 - 1e-9
    assert abs(np.corrcoef(gains.T)[0, 2]) < 0.9


def test_texture_stays_on_the_floor():
    one = renderer([], ideal(floor_texture=0.1))
    image = one.render(DOWN, 0, 0.0)
    assert 4 < image[..., 0].std() < 12
    shifted = one.render(Pose.from_yaw([0.1, 0.0, 1.0], 0.0), 0, 0.0)
    assert_array_equal(shifted[26:, :, 0], image[:-26, :, 0])


def test_jpeg_changes_little():
    sharp = [disc([0.0, 0.0], 0.015, MARKER)]
    plain = renderer(sharp).render(DOWN, 0, 0.0).astype(int)
    coded = renderer(sharp, ideal(jpeg_quality=90)).render(DOWN, 0, 0.0)
    assert 0 < np.abs(coded - plain).mean() < 2


def test_a_scene_holds_all_and_markers_on_top():
    counts = {'sheets': 2, 'lines': 3, 'purple': 4, 'cyan': 1, 'large': 2}
    settings = RenderSettings.model_validate({'distractors': counts})
    space = {'bounds': [[0, 3], [0, 3]], 'obstacles': [{'centre': [1, 1], 'radius': 0.1}]}
    environment = EnvironmentSettings.model_validate(space)
    world = World.from_settings(environment, TargetSettings(count=5), 3)
    shapes = scene_of(world, settings, 3)
    assert len(shapes) == 12 + 1 + 5
    assert_allclose([shape.centre for shape in shapes[-5:]], world.targets)
    assert shapes[12].half_size == (0.1, 0.1)
    again = draw_distractors(settings, world, noise_stream(3, purpose='distractors'))
    assert again == shapes[:12]


@pytest.mark.parametrize(
    'values', [{'marker_colour': [0, 0, 2]}, {'floor_colour': [0, 0]}, {'distractors': {'cats': 1}}]
)
def test_wrong_settings_are_refused(values):
    with pytest.raises(ValidationError):
        RenderSettings.model_validate(values)
