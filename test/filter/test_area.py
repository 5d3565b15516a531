"""Areas, keep-outs and priors: how they are given, and where targets are expected."""

import json
import sys

import numpy as np
import pytest
import rasterio
import shapely
from PIL import Image
from pydantic import ValidationError
from rasterio.warp import transform

from maasi_filter import BoxDetection, Pose, UnexploredMap
from maasi_filter.geometry.area import Area, level_shape
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, geodetic, to_map
from maasi_filter.ros.keep_outs import with_keep_outs
from maasi_filter.ros.node_parameters import check
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten, unflatten

RING = [[0.0, 0.0], [40.0, 0.0], [40.0, 30.0], [10.0, 30.0]]
HOLE = [[20.0, 10.0], [26.0, 10.0], [26.0, 16.0], [20.0, 16.0]]
SQUARE = [[30.0, 20.0], [36.0, 20.0], [36.0, 26.0], [30.0, 26.0]]
ORIGIN = OriginSettings(latitude=46.6, longitude=9.9, altitude=1800.0)


def environment(**values):
    return EnvironmentSettings.model_validate(values)


def degrees(ring):
    """Return a closed ring as GeoJSON has it."""
    places = geodetic(np.array([*ring, ring[0]]), ORIGIN)
    return places[:, [1, 0]].tolist()


def feature(*rings, **properties):
    shape = {'type': 'Polygon', 'coordinates': [degrees(ring) for ring in rings]}
    return {'type': 'Feature', 'properties': properties, 'geometry': shape}


def test_the_forms_of_an_area_are_the_same_area(tmp_path):
    collection = {
        'type': 'FeatureCollection',
        'features': [
            feature(RING, HOLE),
            feature(SQUARE, role='keep_out'),
            feature(HOLE, role='prior', weight=3.0),
        ],
    }
    file = tmp_path / 'field.geojson'
    file.write_text(json.dumps(collection))
    rings = environment(area=[RING, HOLE], keep_outs=[SQUARE])
    text = environment(area=rings.area, keep_outs=[rings.keep_outs[0].polygon])
    of_file = environment(area=str(file), origin=ORIGIN)
    assert text == rings and rings.dimension == 2 and rings.bounds == [[0.0, 40.0], [0.0, 30.0]]
    for made in (rings, text, of_file):
        region = Area(made).region
        assert region.area == pytest.approx(1050.0 - 36.0 - 36.0, rel=1e-6)
        assert region.symmetric_difference(Area(rings).region).area < 0.1
    assert of_file.prior.polygons[0].weight == 3.0
    centre = environment(area=str(file)).origin
    assert centre.latitude == pytest.approx(46.6, abs=1e-3)
    # As it is drawn on the page of a run: where its map is, or in metres.
    drawn = environment(area=feature(RING, HOLE, origin=ORIGIN.model_dump()))
    shape = {'type': 'Polygon', 'coordinates': [[*ring, ring[0]] for ring in (RING, HOLE)]}
    metres = {'type': 'Feature', 'properties': {'unit': 'm'}, 'geometry': shape}
    metres = environment(area=metres)
    assert drawn.origin == ORIGIN and metres.origin is None
    whole = Area(environment(area=[RING, HOLE])).region
    for made in (drawn, metres):
        assert Area(made).region.symmetric_difference(whole).area < 0.1
    solid = environment(area=[RING, HOLE], altitude=[0.0, 20.0])
    assert solid.dimension == 3 and Area(solid).volume == pytest.approx(20280.0, rel=0.01)


def test_an_environment_survives_the_parameters_of_a_node():
    prior = {'polygons': [{'polygon': HOLE, 'weight': 2.0}], 'floor': 0.1}
    zones = [SQUARE, {'centre': [5.0, 6.0], 'radius': 1.5}]
    given = environment(
        area=RING, keep_outs=zones, obstacles=zones, prior=prior, origin=ORIGIN, altitude=[0.0, 9.0]
    )
    flat = {f'environment.{key}': value for key, value in flatten(given).items()}
    nested = unflatten(FilterNodeSettings, {**flat, 'robots': []})['environment']
    assert EnvironmentSettings.model_validate(nested) == given
    assert flat['environment.keep_outs'][1] == '5.0 6.0 1.5'


BOW = [[0, 0], [9, 9], [9, 0], [0, 9]]
PARTS = [feature(RING), feature(BOW, role='keep_out')]
WRONG = [
    # What is given, the key of the error, and words that it has.
    ({'area': [[0, 0], [1, 1], [1, 0], [0, 1]]}, 'area', r'self-intersection at \(0.50, 0.50\) m'),
    ({'area': [[0, 0], [1, 1]]}, 'area', 'at least 3 corners'),
    ({'area': 'nowhere.geojson'}, 'area', 'nowhere.geojson: No such file'),
    (
        {'area': feature(RING, role='garden')},
        'area',
        'feature 1: role: read garden, allowed are area',
    ),
    (
        {'area': {'type': 'FeatureCollection', 'features': PARTS}},
        'area',
        r'feature 2: self-intersection at longitude 9\.90\d+, latitude 46\.60',
    ),
    ({'area': {'type': 'FeatureCollection', 'features': [3]}}, 'area', 'allowed is a list of'),
    ({'keep_outs': [SQUARE, feature(SQUARE)]}, 'keep_outs.1', 'origin'),
    ({'keep_outs': ['circle']}, 'keep_outs.0', 'read circle, allowed'),
    ({'keep_outs': [{'centre': [1, 2]}]}, 'keep_outs.0', 'centre and radius, or polygon'),
    ({'keep_outs': [{'centre': [1, 2, 3], 'radius': 1}]}, 'keep_outs.0.centre', 'allowed are 2'),
    ({'obstacles': [SQUARE, 'none.yaml']}, 'obstacles.1', 'none.yaml'),
    ({'prior': 'none.geojson'}, 'prior', 'none.geojson: No such file'),
    ({'prior': [3]}, 'prior', 'allowed is GeoJSON'),
    (
        {'prior': {'polygons': [{'polygon': 'x', 'weight': 1}]}},
        'prior.polygons.0.polygon',
        'read x, allowed is GeoJSON',
    ),
    ({'origin': {'latitude': 91, 'longitude': 9}}, 'origin.latitude', 'less than or equal to 90'),
    ({'area': None, 'altitude': [0, 1]}, 'altitude', 'allowed with area'),
    ({'area': None, 'bounds': [[0, 1], [1, 1]]}, 'bounds', r'axis 1: got \[1.0, 1.0\]'),
    (
        {'prior': {'raster': 'heat.npy', 'extent': [[0, 40], [30, 0]]}},
        'prior.extent',
        r'axis 1: got \[30.0, 0.0\], allowed is \[lower, upper\]',
    ),
    ({'keep_outs': [[[]]]}, 'keep_outs.0', 'allowed are corners'),
]


@pytest.mark.parametrize('values, key, words', WRONG)
def test_wrong_environments_are_refused_by_their_key(values, key, words):
    values = {'area': RING, 'bounds': [[0, 1], [0, 1]], **values}
    with pytest.raises(ValidationError, match=words) as caught:
        environment(**values)
    assert ['.'.join(map(str, item['loc'])) for item in caught.value.errors()] == [key]


def test_a_node_names_the_parameter_of_a_wrong_shape():
    """Shapes are texts there."""
    flat = {'robots': [], 'environment.area': 'POLYGON ((0 0, 9 0, 9 9, 0 0))'}
    for key, value in (('keep_outs', ['circle']), ('area', 'POLYGON ((0 0, 9 9, 9 0, 0 9, 0 0))')):
        _, problems = check(FilterNodeSettings, {**flat, f'environment.{key}': value})
        text = problems[f'environment.{key}']
        assert (
            text.startswith(f'parameter environment.{key}: read ') and 'environment' not in problems
        )


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        (
            {'keep_outs': [[[-1, -1], [50, -1], [50, 50], [-1, 50]]]},
            'environment.keep_outs: ',
        ),
        ({'prior': {'raster': 'none.npy'}}, 'environment.prior.raster: none.npy'),
        (
            # But for what rounding leaves.
            {'keep_outs': [[[-1, -1], [41, -1], [41, 31], [9.9999, 30.0001], [-0.0001, 0]]]},
            'environment.keep_outs: ',
        ),
    ],
)
def test_areas_that_cannot_be_used_are_refused(values, words):
    with pytest.raises(ValueError, match=words):
        Area(environment(**{'area': RING, **values}))


def test_the_density_is_made_at_its_first_use():
    """Not by drivers; and a prior that promises only a spot is no error."""
    spot = [[5.0, 2.0], [5.2, 2.0], [5.2, 2.2], [5.0, 2.2]]
    polygons = [{'polygon': RING, 'weight': 0.0}, {'polygon': spot, 'weight': 1.0}]
    field, promised = (environment(area=RING, prior=p) for p in ({}, {'polygons': polygons}))
    area = Area(field)
    places = np.array([[20.0, 10.0], [1.0, 29.0], [50.0, 10.0]])
    assert area.inside(places).tolist() == [True, False, False]
    assert '_rasterised' not in vars(area)
    assert area.volume == pytest.approx(1050.0, rel=0.01)
    assert '_rasterised' in vars(area)
    assert Area(promised).density(np.array([[5.1, 2.1], [20.0, 10.0]])).tolist()[1] == 0.02
    around = Area(environment(bounds=[[0.0, 40.0], [0.0, 30.0]], keep_outs=[SQUARE]))
    places = np.array([[33.0, 23.0, 5.0], [20.0, np.nan, 5.0], [1.0, 1.0, 5.0]])
    assert around.inside(places, bounded=False).tolist() == [False, False, True]
    box = Area(environment(bounds=[[0.0, 40.0], [0.0, 30.0]]))
    assert box.inside([[-0.1, 5.0]], bounded=False)[0] and not box.inside([[-0.1, 5.0]])[0]


def test_a_map_of_nav2_is_obstacles(tmp_path):
    """Walls and a pillar; unknown cells (205) are free."""
    cells = np.full((40, 60), 254, np.uint8)
    cells[0], cells[-1], cells[:, 0], cells[:, -1] = 0, 0, 0, 0
    cells[10:14, 20:24], cells[30:, 40:50] = 0, 205
    Image.fromarray(cells).save(tmp_path / 'room.pgm')
    file = tmp_path / 'room.yaml'
    facts = {'image': 'room.pgm', 'resolution': 0.05, 'origin': [-1.0, -0.5, 0.0], 'negate': 0}
    file.write_text(json.dumps({**facts, 'occupied_thresh': 0.65, 'free_thresh': 0.25}))
    area = Area(environment(bounds=[[-1.0, 2.0], [-0.5, 1.5]], obstacles=[str(file)]))
    places = np.random.default_rng(901).uniform([-1.0, -0.5, 0.0], [2.0, 1.5, 0.0], (2000, 3))
    columns = ((places[:, 0] + 1.0) / 0.05).astype(int)
    rows = 39 - ((places[:, 1] + 0.5) / 0.05).astype(int)
    gaps = np.array([area.distances(place).min() for place in places])
    assert (gaps[cells[rows, columns] == 0] == 0.0).all()
    assert (gaps[cells[rows, columns] != 0] > 0.0).all()
    # A pillar of 0.2 m around (0.1, 0.9).
    assert area.distances([0.5, 0.9, 0.0]).min() == pytest.approx(0.3, abs=1e-6)
    assert area.distances([1.3, 0.0, 0.0]).min() > 0.3


def test_the_density_is_prior_times_inside_with_mean_one(tmp_path):
    raster = np.zeros((30, 40))
    raster[:15, 20:] = 4.0  # North east.
    file = tmp_path / 'prior.npy'
    np.save(file, raster)
    area = Area(environment(area=[RING, HOLE], keep_outs=[SQUARE], prior=str(file)))
    rng = np.random.default_rng(900)
    places = rng.uniform([0.0, 0.0], [40.0, 30.0], (200_000, 2))
    density, inside = area.density(places), area.inside(places)
    # Cells of the raster are 8 cm wide, so that places near the border may be of either.
    border = area.region.boundary.buffer(0.1)
    sure = ~shapely.contains_xy(border, places[:, 0], places[:, 1])
    assert ((density > 0.0) == inside)[sure].all()
    assert density[inside].mean() == pytest.approx(1.0, rel=0.02)
    promised = inside & (places[:, 0] > 20.1) & (places[:, 1] > 15.1)
    poor = inside & ((places[:, 0] < 19.9) | (places[:, 1] < 14.9))
    assert density[poor].max() == pytest.approx(0.02)
    assert np.ptp(density[promised & sure]) == 0.0
    drawn = [area.draw(rng, *area.bounds.T, by_prior=True) for _ in range(4000)]
    drawn = np.array([place for place in drawn if place is not None])
    east = (drawn[:, 0] > 20.0) & (drawn[:, 1] > 15.0)
    expected = 0.98 + 0.02 * promised.sum() / inside.sum()
    # Four deviations of a share.
    assert east.mean() == pytest.approx(expected, abs=4.0 * 0.14 / np.sqrt(len(drawn)))


@pytest.mark.parametrize('crs', ['EPSG:4326', 'EPSG:32632'])
def test_a_geotiff_is_the_same_prior_as_its_values_in_the_map(crs, tmp_path, monkeypatch):
    """10 km by 8 km; UTM's grid is turned by 0.6 degrees here, and 0.02 % short."""
    rows, columns = 80, 100
    x, y = np.meshgrid((np.arange(columns) + 0.5) * 100.0, (rows - 0.5 - np.arange(rows)) * 100.0)

    def likely(x, y):
        return np.maximum(0.0, np.sin(x / 1500.0) + np.cos(y / 1100.0) + 1.0)

    np.save(tmp_path / 'heat.npy', likely(x, y))
    corners = geodetic(np.array([[-500.0, -500.0], [10500.0, 8500.0]]), ORIGIN)
    (west, east), (south, north) = transform('EPSG:4326', crs, corners[:, 1], corners[:, 0])
    grid = rasterio.transform.from_bounds(west, south, east, north, 440, 360)
    easts = west + (np.arange(440) + 0.5) * (east - west) / 440
    norths = north - (np.arange(360) + 0.5) * (north - south) / 360
    cells = [axis.ravel() for axis in np.meshgrid(easts, norths)]
    values = likely(*to_map(np.transpose(transform(crs, 'EPSG:4326', *cells)), ORIGIN).T)
    values = np.where(values == 0.0, -9999.0, values).reshape(360, 440)
    facts = {'driver': 'GTiff', 'width': 440, 'height': 360, 'count': 1, 'dtype': 'float64'}
    path = str(tmp_path / 'heat.tif')
    with rasterio.open(path, 'w', crs=crs, transform=grid, nodata=-9999.0, **facts) as file:
        file.write(values, 1)
    bounds = [[0.0, 10000.0], [0.0, 8000.0]]
    plain = Area(environment(bounds=bounds, prior=str(tmp_path / 'heat.npy')))
    area = Area(environment(bounds=bounds, prior=path, origin=ORIGIN))
    places = np.random.default_rng(902).uniform(*plain.bounds.T, (20000, 2))
    gaps = np.abs(area.density(places) - plain.density(places))
    # Within a cell of 100 m, of a density of up to 3, it changes by 0.15.
    assert gaps.max() < 0.1 and gaps.mean() < 0.02
    with pytest.raises(ValueError, match=r'heat\.tif: .*environment\.origin'):
        Area(environment(bounds=bounds, prior=path))
    monkeypatch.setitem(sys.modules, 'rasterio', None)
    with pytest.raises(ValueError, match=r'prior\.raster: .*heat\.tif: .*rasterio'):
        Area(environment(bounds=bounds, prior=path, origin=ORIGIN))


def test_the_map_counts_what_is_expected_only():
    """A look at a quarter of the area with most of the prior explores most of it."""
    quarter = [[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]]
    prior = {'polygons': [{'polygon': quarter, 'weight': 27.0}], 'floor': 0.0}
    area = Area(environment(bounds=[[0.0, 40.0], [0.0, 40.0]], prior=prior))
    explored = UnexploredMap(area, 1.0)
    assert explored.cell_volumes().sum() == pytest.approx(1600.0, rel=0.02)
    explored.update(BoxDetection([-10.0, -10.0], [10.0, 10.0], 1.0), Pose(np.array([10.0, 10.0])))
    assert explored.explored_fraction() == pytest.approx(0.9, abs=0.03)
    assert explored.unseen()[0, 0] == 0.0 and explored.unseen()[-1, -1] == 1.0
    uniform = UnexploredMap([[0.0, 40.0], [0.0, 40.0]], 1.0)
    assert (uniform.unseen() == uniform.values).all()
    explored.adopt_area(uniform.area)
    assert (explored.cell_volumes() == uniform.cell_volumes()).all()


def square(x, y, half):
    return [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]]


def random_environment(rng):
    """Return the values of an area, with parts of the prior and zones that may cover it all."""
    floor = float(rng.choice([0.0, 0.02, 1.0]))
    polygons = [
        {
            'polygon': square(*rng.uniform(-10.0, 50.0, 2), rng.uniform(0.05, 40.0)),
            'weight': float(rng.choice([0.0, 1e-300, 1.0, 30.0, 1e308])),
        }
        for _ in range(rng.integers(0, 4))
    ]
    if rng.uniform() < 0.5:
        # Only what is named is likely.
        polygons.insert(0, {'polygon': square(20.0, 15.0, 60.0), 'weight': 0.0})
    zones = [
        {'centre': rng.uniform(-10.0, 50.0, 2).tolist(), 'radius': float(rng.uniform(0.1, 25.0))}
        if rng.uniform() < 0.5
        else square(*rng.uniform(-10.0, 50.0, 2), rng.choice([0.05, 5.0, 25.0, 50.0]))
        for _ in range(rng.integers(0, 5))
    ]
    values = {'area': RING} if rng.uniform() < 0.7 else {'bounds': [[0.0, 40.0], [0.0, 30.0]]}
    return values | {'keep_outs': zones, 'prior': {'polygons': polygons, 'floor': floor}}


def test_a_keep_out_always_wins_over_the_prior():
    """Whatever zones and prior are: an area results where ground is left, with mean 1."""
    rng = np.random.default_rng(903)
    even = refused = 0
    for _ in range(150):
        values = random_environment(rng)
        settings = environment(**values)
        whole = shapely.Polygon(RING) if 'area' in values else shapely.box(0.0, 0.0, 40.0, 30.0)
        left = whole.difference(shapely.union_all(list(map(level_shape, settings.keep_outs))))
        if left.buffer(-1e-3).is_empty:
            with pytest.raises(ValueError, match=r'environment\.keep_outs: '):
                Area(settings)
            refused += 1
            continue
        area = Area(settings)
        places = rng.uniform([0.0, 0.0], [40.0, 30.0], (20_000, 2))
        density = area.density(places)
        assert np.isfinite(density).all() and (density >= 0.0).all()
        inner = shapely.contains_xy(left.buffer(-0.1), places[:, 0], places[:, 1])
        outer = ~shapely.contains_xy(left.buffer(0.1), places[:, 0], places[:, 1])
        assert not density[outer].any()
        if any('is 0 everywhere' in warning for warning in area.warnings):
            even += 1
            assert (density[inner] == 1.0).all()
        elif values['prior']['floor'] > 0.0:
            assert (density[inner] > 0.0).all()
        # Cells of the density are 8 cm wide.
        rough = 0.1 * left.length + 0.1
        assert area.volume == pytest.approx(left.area, abs=rough)
        found = UnexploredMap(area, 2.0)
        assert found.density.max() > 0.0 and found.explored_fraction() == 0.0
    assert even >= 5 and refused >= 2


def test_slivers_between_the_cells_of_the_density_are_ground():
    """Of 1 mm, where no middle of a cell is."""
    slit = (
        [[-1, 15.001], [41, 15.001], [41, 31], [-1, 31]],
        [[-1, -1], [41, -1], [41, 15], [-1, 15]],
    )
    area = Area(environment(bounds=[[0.0, 40.0], [0.0, 30.0]], keep_outs=list(slit)))
    assert area.region.area == pytest.approx(0.04, rel=1e-3)
    assert area.volume == pytest.approx(0.04, rel=1e-3)
    assert area.density(np.array([[20.0, 15.0005]])).tolist() == [1.0]
    unexplored = UnexploredMap(area, 2.0)
    assert unexplored.density.max() > 0.0 and unexplored.explored_fraction() == 0.0
    around = BoxDetection([-50.0, -20.0], [50.0, 20.0], 1.0)
    unexplored.update(around, Pose(np.array([20.0, 15.0])))
    assert unexplored.explored_fraction() == 1.0
    assert Area(environment(area=[[0, 0], [40, 40], [39.99, 40]])).volume == pytest.approx(0.2)


def test_zones_and_priors_far_from_the_area_are_doubted_by_name():
    far = [[x + 90.0, y] for x, y in SQUARE]
    prior = {'polygons': [{'polygon': RING, 'weight': 2.0}, {'polygon': far, 'weight': 2.0}]}
    zones = [SQUARE, far, {'centre': [50.0, 10.0], 'radius': 2.0}, square(-4e6, 2.5e6, 9.0)]
    area = Area(environment(area=RING, keep_outs=zones, prior=prior, obstacles=[far]))
    assert [warning.split(' outside')[0] for warning in area.warnings] == [
        'environment.keep_outs[1]: lies 80 m',
        'environment.keep_outs[2]: lies 8 m',
        'environment.keep_outs[3]: lies 4,717 km',
        'environment.obstacles[0]: lies 80 m',
        'environment.prior.polygons[1]: lies 80 m',
        area.warnings[-1],
    ]
    assert area.warnings[-1].startswith('environment.prior: ')
    assert Area(environment(area=RING, keep_outs=[SQUARE])).warnings == []


def test_rasters_of_any_size_and_weight_are_taken_or_refused_by_name(tmp_path):
    heat = np.ones((30, 40))
    heat[:15] = 1e308
    np.save(tmp_path / 'heat.npy', heat)
    prior = {'polygons': [{'polygon': SQUARE, 'weight': 1e308}], 'floor': 0.0}
    area = Area(environment(area=RING, prior=prior | {'raster': str(tmp_path / 'heat.npy')}))
    north, south = area.density(np.array([[33.0, 23.0], [20.0, 5.0]]))
    assert np.isfinite(north) and north > 10.0 and south == 0.0
    wrong = {
        'many.npy': '20000 x 20000 cells',
        'many.png': 'scale ',
        'empty.npy': 'is not a complete array',
    }
    np.save(tmp_path / 'words.npy', np.array(['a', 'b']))
    np.save(tmp_path / 'line.npy', np.ones(3))
    np.save(tmp_path / 'below.npy', np.array([[1.0, -9999.0]]))
    (tmp_path / 'text.tif').write_text('no picture')
    wrong |= {
        'words.npy': 'is an array of other things',
        'line.npy': 'got 3 numbers, allowed are two axes',
        'below.npy': 'got -9999, allowed are finite numbers from 0; if it means no data',
        'gone.npy': 'No such file or directory$',
    }
    with open(tmp_path / 'many.npy', 'wb') as file:
        head = {'descr': '<f8', 'fortran_order': False, 'shape': (20000, 20000)}
        np.lib.format.write_array_header_1_0(file, head)
        # Without its content, which takes no space on the disk.
        file.truncate(file.tell() + 8 * 20000**2)
    Image.new('1', (20000, 20000)).save(tmp_path / 'many.png')
    Image.new('1', (9000, 9000)).save(tmp_path / 'some.png')
    (tmp_path / 'empty.npy').touch()
    for name, words in (wrong | {'some.png': '9000 x 9000 cells, allowed are'}).items():
        with pytest.raises(ValueError, match=rf'environment\.prior\.raster: .*{name}: .*{words}'):
            Area(environment(area=RING, prior=str(tmp_path / name)))
    facts = {'image': 'many.png', 'resolution': 0.05, 'origin': [0, 0, 0], 'negate': 0}
    (tmp_path / 'room.yaml').write_text(json.dumps({**facts, 'occupied_thresh': 0.65}))
    with pytest.raises(ValidationError, match=r'room\.yaml: .*scale '):
        environment(area=RING, obstacles=[str(tmp_path / 'room.yaml')])


def test_zones_that_are_received_name_no_files(tmp_path):
    file = tmp_path / 'zone.geojson'
    file.write_text(json.dumps(feature(SQUARE)))
    field = environment(area=RING, origin=ORIGIN)
    wkt = 'POLYGON ((30 20, 36 20, 36 26, 30 26, 30 20))'
    texts = ['3 2 1', wkt, json.dumps(SQUARE), json.dumps(feature(SQUARE)), file.read_text()]
    area = with_keep_outs(field, [f' {text} ' for text in texts])
    kept = list(map(level_shape, area.settings.keep_outs))
    assert len(kept) == 5 and all(shape.equals_exact(kept[1], 1e-3) for shape in kept[2:])
    names = [str(file), f'../{file.name}', '/etc/hosts', 'room.yaml', '1.geojson', '', '{', '[']
    for name in [*names, json.dumps({'polygon': str(file)}), json.dumps([str(file)]), '[[]]']:
        with pytest.raises(ValueError, match=r'keep_outs(: |\.)1: ') as caught:
            with_keep_outs(field, [wkt, name])
        message = str(caught.value)
        assert '\n' not in message and 'No such file' not in message, message
