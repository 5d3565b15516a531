"""From objects to cuboids (004, IV), and what cannot be searched."""

import numpy as np
import pytest

from maasi_planner.buildings.preplanning import detection_probability, footprint, plan_mission
from maasi_planner.buildings.settings import CuboidSettings, SearchCameraSettings

AREA = [[0, 300], [0, 300], [0, 80]]
BUILDING = {'centre': [175, 130], 'size': [60, 60, 60]}


def mission(probability=0.88, area=AREA, objects=(BUILDING,), **others):
    return plan_mission(
        CuboidSettings(objects=list(objects), detection_probability=probability, **others), area
    )


@pytest.mark.parametrize(
    ('probability', 'distance', 'number', 'strict'),
    [(1.0, 17.0, 36, 64), (0.88, 25.76, 16, 36), (0.53, 51.31, 4, 16)],
)
def test_cells_of_the_paper_and_of_strict_coverage(probability, distance, number, strict):
    made = mission(probability)
    assert made.distance == pytest.approx(distance)
    assert len(made.cells) == number
    full = mission(probability, coverage='strict')
    assert len(full.cells) == strict
    assert full.coverage == pytest.approx(1.0)
    # Coverage is what the footprints show.
    side = 2 * distance * np.tan(np.pi / 6)
    assert made.footprint == pytest.approx(side)
    assert made.coverage == pytest.approx(number / 4 * (side / 60) ** 2)


def test_cuboids_stand_in_front_of_their_cells():
    made = mission()
    for cell, centre in zip(made.cells, made.centres):
        assert cell.distance(centre) == pytest.approx(made.distance)
        across = np.flatnonzero(cell.normal == 0.0)
        assert centre[across] == pytest.approx(cell.centre[across])
        assert made.inside(centre).sum() == 1
    # Every face is tiled: the cells' areas add up.
    assert sum(np.prod(cell.size) for cell in made.cells) == pytest.approx(4 * 60 * 60)
    low = mission(objects=[{'centre': [150, 150], 'size': [20, 20, 6]}])
    assert len(low.cells) == 4
    # Cut to the area.
    assert (low.boxes[:, 2] == [0.0, 8.0]).all()


def test_probability_by_distance():
    camera = SearchCameraSettings()
    places = [16.9, 17.0, 53.5, 90.0, 200.0]
    expected = pytest.approx([0.0, 1.0, 0.5, 0.0, 0.0])
    assert [detection_probability(place, camera) for place in places] == expected
    assert footprint(17.0, camera) == pytest.approx(19.63, abs=0.01)


@pytest.mark.parametrize(
    ('faces', 'obstacle', 'lost'),
    [
        (['west', 'top', 'bottom'], None, {('top', 'above the ceiling'), ('bottom', 'below the')}),
        (None, {'centre': [115, 130], 'size': [50, 60, 80]}, {('west', 'inside another object')}),
        # A thin wall in the view is seen.
        (
            None,
            {'centre': [135, 130], 'size': [2, 80, 80]},
            {('west', 'the view')},
        ),
    ],
)
def test_what_cannot_be_searched_is_lost_with_its_reason(faces, obstacle, lost):
    building = BUILDING | ({'faces': faces} if faces else {})
    made = mission(objects=[building], obstacles=[obstacle] if obstacle else [])
    reasons = {(cell.face, reason) for cell, reason in made.lost}
    assert {face for face, _ in reasons} == {face for face, _ in lost}
    assert all(any(text in reason for _, text in lost) for _, reason in reasons)
    assert {cell.face for cell in made.cells}.isdisjoint(face for face, _ in lost)
    searched = 1 / 3 if faces else 3 / 4
    assert made.coverage == pytest.approx(searched * mission().coverage, abs=0.01)


def test_a_cuboid_is_cut_to_the_part_beside_an_obstacle():
    wall = {'centre': [115, 130], 'size': [12, 300, 80]}
    made = mission(obstacles=[wall])
    west = [cell for cell in made.cells if cell.face == 'west']
    assert len(west) == 4
    for cell in west:
        assert cell.box[0, 0] == pytest.approx(121.01)
        assert not made.hits(cell.box.mean(axis=1))


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'obstacles': [BUILDING | {'centre': [900, 130]}]}, r'obstacles\[0\]: read centre'),
        ({'probability': 0.0}, r'detection_probability'),
        ({'camera': {'least_distance': 90.0}}, r'least_distance: got 90.0'),
        ({'objects': [BUILDING | {'centre': [float('nan'), 130]}]}, r'centre'),
    ],
)
def test_bad_input(changes, words):
    with pytest.raises(ValueError, match=words):
        mission(**changes)
