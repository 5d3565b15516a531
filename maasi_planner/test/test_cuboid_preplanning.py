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
    assert made.coverage < 1.0


def test_coverage_is_what_the_footprints_show():
    made = mission(1.0)
    side = 2 * 17 * np.tan(np.pi / 6)
    assert made.footprint == pytest.approx(side)
    assert made.coverage == pytest.approx((3 * side / 60) ** 2)


def test_cuboids_stand_in_front_of_their_cells():
    made = mission(0.88)
    for cell, centre in zip(made.cells, made.centres):
        assert cell.distance(centre) == pytest.approx(made.distance)
        across = np.flatnonzero(cell.normal == 0.0)
        assert centre[across] == pytest.approx(cell.centre[across])
        assert made.inside(centre).sum() == 1
    # Every face is tiled: the cells' areas add up.
    assert sum(np.prod(cell.size) for cell in made.cells) == pytest.approx(4 * 60 * 60)


def test_probability_by_distance():
    camera = SearchCameraSettings()
    assert detection_probability(16.9, camera) == 0.0
    assert detection_probability(17.0, camera) == 1.0
    assert detection_probability(53.5, camera) == pytest.approx(0.5)
    assert detection_probability(90.0, camera) == 0.0
    assert detection_probability(200.0, camera) == 0.0
    assert footprint(17.0, camera) == pytest.approx(19.63, abs=0.01)


def test_cuboids_are_cut_to_the_area():
    low = {'centre': [150, 150], 'size': [20, 20, 6]}
    made = mission(objects=[low])
    assert len(made.cells) == 4
    assert (made.boxes[:, 2, 0] == 0.0).all() and (made.boxes[:, 2, 1] == 8.0).all()


def test_what_cannot_be_searched_is_lost_with_its_reason():
    made = mission(objects=[{**BUILDING, 'faces': ['west', 'top', 'bottom']}])
    assert {cell.face for cell in made.cells} == {'west'}
    reasons = {cell.face: reason for cell, reason in made.lost}
    assert reasons == {
        'top': 'a cuboid is above the ceiling',
        'bottom': 'a cuboid is below the floor',
    }
    assert made.coverage == pytest.approx(1 / 3, abs=0.01)
    beside = {'centre': [115, 130], 'size': [50, 60, 80]}
    made = mission(obstacles=[beside])
    reasons = {(cell.face, reason) for cell, reason in made.lost}
    assert reasons == {('west', 'a cuboid is inside another object')}
    assert len(made.cells) == 12


def test_a_thin_wall_in_the_view_is_seen():
    made = mission(obstacles=[{'centre': [135, 130], 'size': [2, 80, 80]}])
    reasons = {(cell.face, reason) for cell, reason in made.lost}
    assert reasons == {('west', 'another object stands in the view of a cuboid')}


def test_a_cuboid_is_cut_to_the_part_beside_an_obstacle():
    wall = {'centre': [115, 130], 'size': [12, 300, 80]}
    made = mission(obstacles=[wall])
    west = [cell for cell in made.cells if cell.face == 'west']
    assert len(west) == 4
    for cell in west:
        assert cell.box[0, 0] == pytest.approx(121.01)
        assert not made.hits(cell.box.mean(axis=1))


def test_bad_input():
    with pytest.raises(ValueError, match=r'objects: got none'):
        mission(objects=[])
    with pytest.raises(ValueError, match=r'objects\[0\]: read centre .*inside the area'):
        mission(objects=[{'centre': [290, 130], 'size': [60, 60, 60]}])
    with pytest.raises(ValueError, match=r'obstacles\[0\]: read centre'):
        mission(obstacles=[{'centre': [900, 130], 'size': [60, 60, 60]}])
    with pytest.raises(ValueError, match=r'no cuboid can be reached .*outside the area'):
        mission(area=[[144, 206], [99, 161], [0, 80]])
    with pytest.raises(ValueError, match=r'detection_probability'):
        mission(probability=0.0)
    with pytest.raises(ValueError, match=r'least_distance: got 90.0'):
        SearchCameraSettings(least_distance=90.0)
    with pytest.raises(ValueError, match=r'centre'):
        mission(objects=[{'centre': [float('nan'), 130], 'size': [60, 60, 60]}])
