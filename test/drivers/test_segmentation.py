"""Blue markers in an image."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import ndimage

from maasi_drivers.settings.camera import SegmentationSettings
from maasi_drivers.vision.segmentation import paper_mask, segment

PAPER = SegmentationSettings(rule='paper')
EVERY_PIXEL = SegmentationSettings(rule='paper', minimum_area=0.0)
ROBUST = SegmentationSettings(rule='robust')
BLUE = (20, 45, 160)


def floor(height=120, width=160, grey=120):
    return np.full((height, width, 3), grey, dtype=np.uint8)


def draw_disc(image, x, y, radius, colour=BLUE, samples=8):
    """Blend a disc into an image, each pixel by how much of it is covered."""
    fine = (np.arange(samples) + 0.5) / samples - 0.5
    rows, columns, dy, dx = np.ix_(*map(np.arange, image.shape[:2]), fine, fine)
    inside = (columns + dx - x) ** 2 + (rows + dy - y) ** 2 <= radius**2
    cover = inside.mean(axis=(2, 3))[..., None]
    image[:] = np.round(image * (1 - cover) + cover * np.array(colour)).astype(np.uint8)
    return image


def test_the_papers_mask_is_equation_16_to_the_half_grey_level():
    levels = np.array([0, 1, 17, 34, 35, 36, 37, 70, 71, 128, 254, 255])
    red, green, blue = np.meshgrid(levels, levels, levels, indexing='ij')
    image = np.stack([red, green, blue], axis=-1).reshape(-1, 12, 3).astype(np.uint8)
    r, g, b = (image[..., i].astype(float) for i in range(3))
    assert_array_equal(paper_mask(image, 35.0), b - r / 2 - g / 2 > 35.0)
    assert_array_equal(paper_mask(image, 12.25), b - r / 2 - g / 2 > 12.25)


def test_the_papers_rule_leaves_out_specks_and_takes_the_plain_centroid_of_the_pixels():
    image = draw_disc(floor(), 80.0, 60.0, 3.0)
    image[[10, 10, 11, 12], [20, 21, 20, 20]] = BLUE
    image[20, 30:33] = BLUE
    blobs = segment(image, PAPER)
    assert_allclose(blobs.centroids[0], [20.25, 10.75])
    assert_allclose(blobs.areas[0], 4)
    assert_array_equal(blobs.extents[0], [2, 3])
    assert len(blobs) == 2 and len(segment(image, EVERY_PIXEL)) == 3


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.0, 0.9))
def test_components_agree_with_scipy(seed, share):
    generator = np.random.default_rng(seed)
    marked = generator.random((13, 17)) < share
    image = floor(13, 17)
    image[marked] = BLUE
    labels, count = ndimage.label(marked, structure=np.ones((3, 3)))
    blobs = segment(image, EVERY_PIXEL)
    assert len(blobs) == count
    index = np.arange(1, count + 1)
    expected = np.array(ndimage.center_of_mass(marked, labels, index)).reshape(-1, 2)[:, ::-1]
    assert_allclose(blobs.centroids, expected, atol=1e-12)
    assert_array_equal(blobs.areas, ndimage.sum_labels(marked, labels, index))
    frame = np.zeros_like(marked)
    frame[[0, -1]] = frame[:, [0, -1]] = True
    cut = ndimage.sum_labels(marked & frame, labels, index) > 0
    assert_array_equal(blobs.border_cut, cut)


# The paper's rule marks in each row the pixels whose centre is at most some distance from x: the
# middle of each row, and so the centroid, is within half a pixel of x. Columns likewise.
@pytest.mark.parametrize(('rule', 'tolerance'), [(PAPER, 0.5), (ROBUST, 0.03)])
@settings(max_examples=25, deadline=None)
@given(x=st.floats(20, 140), y=st.floats(20, 100), radius=st.floats(2.5, 8.0))
def test_a_disc_is_one_blob_at_its_centre(rule, tolerance, x, y, radius):
    blobs = segment(draw_disc(floor(), x, y, radius), rule)
    assert len(blobs) == 1
    assert_allclose(blobs.centroids[0], [x, y], atol=tolerance)
    assert not blobs.border_cut[0]
    # The paper's rule counts pixels that are partly marker, up to half a pixel outside the disc.
    largest = max(0.3, (1.0 + 0.5 / radius) ** 2 - 1.0) if rule is PAPER else 0.03
    assert abs(blobs.areas[0] / (np.pi * radius**2) - 1) < largest


@pytest.mark.parametrize('gains', [(1.25, 1.0, 0.75), (0.8, 1.0, 1.25), (0.4, 0.4, 0.4)])
def test_the_robust_rule_does_not_mind_white_balance_and_exposure(gains):
    image = draw_disc(floor(), 70.3, 50.8, 4.0)
    blobs = segment(np.clip(image * np.array(gains), 0, 255).astype(np.uint8), ROBUST)
    assert_allclose(blobs.centroids, [[70.3, 50.8]], atol=0.05)


@pytest.mark.parametrize(
    'colour', [(150, 170, 200), (105, 30, 125), (90, 140, 155), (160, 40, 20), (10, 10, 10)]
)
def test_the_robust_rule_leaves_out_other_colours(colour):
    assert len(segment(draw_disc(floor(), 70, 50, 4.0, colour), ROBUST)) == 0


def test_the_robust_rule_leaves_out_what_is_darker_than_the_blue_around_it():
    image = draw_disc(floor(), 70.0, 50.0, 14.0, (150, 160, 220))
    assert len(segment(draw_disc(image, 70.0, 50.0, 4.0, (5, 8, 30)), ROBUST)) == 0


def test_the_robust_rule_leaves_out_lines_and_rings_and_keeps_the_disc_beside():
    image = draw_disc(floor(), 30.0, 30.0, 4.0)
    image[60:62, 20:90] = BLUE
    draw_disc(draw_disc(image, 110.0, 80.0, 9.0), 110.0, 80.0, 6.5, (120, 120, 120))
    blobs = segment(image, ROBUST)
    assert_allclose(blobs.centroids, [[30.0, 30.0]], atol=0.05)


def test_the_robust_rule_under_noise_says_how_far_centroids_may_be_off():
    generator = np.random.default_rng(4)
    clean = draw_disc(floor(), 80.4, 60.7, 4.0).astype(float)
    errors, variances = [], []
    for _ in range(200):
        noisy = clean + generator.normal(0.0, 9.0, clean.shape)
        blobs = segment(np.clip(np.round(noisy), 0, 255).astype(np.uint8), ROBUST)
        assert len(blobs) == 1
        errors.append(blobs.centroids[0] - [80.4, 60.7])
        variances.append(np.diagonal(blobs.covariances[0]))
    normalised = np.mean(np.square(errors) / np.array(variances))
    assert 0.6 < normalised < 1.6


@pytest.mark.parametrize('rule', [PAPER, ROBUST])
def test_noise_all_over_is_no_crash_and_an_empty_floor_has_no_blobs(rule):
    generator = np.random.default_rng(5)
    for shape in [(120, 160, 3), (1, 1, 3), (2, 9, 3), (9, 2, 3)]:
        segment(generator.integers(0, 256, shape).astype(np.uint8), rule)
    for level in (0, 120, 255):
        blobs = segment(floor(grey=level), rule)
        assert blobs.centroids.shape == (0, 2) and blobs.covariances.shape == (0, 2, 2)


def test_read_only_and_strided_images_give_the_same():
    image = draw_disc(floor(), 70.3, 50.8, 4.0)
    padded = np.zeros((120, 170, 3), dtype=np.uint8)
    padded[:, :160] = image
    frozen = np.frombuffer(image.tobytes(), dtype=np.uint8).reshape(image.shape)
    for rule in (PAPER, ROBUST):
        found = [segment(item, rule).centroids for item in (image, frozen, padded[:, :160])]
        assert_array_equal(found[1:], [found[0]] * 2)
