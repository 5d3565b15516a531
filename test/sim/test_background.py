"""The picture under the map: it lies where its file says, or is refused with what to do."""

import base64
import re

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.scene import scene_of
from maasi_sim.scenario.background import background_of, background_problems
from maasi_sim.scenario.loading import config_folder, load_scenario
from maasi_sim.scenario.schema import Scenario

ORIGIN = {'latitude': 46.6, 'longitude': 9.9}
BOUNDS = [[-100.0, 300.0], [-50.0, 250.0]]
CRS = ('EPSG:4326', 'EPSG:32632', 'EPSG:3857')


def colour_of(places):
    """Return the colour of positions (..., 2) [m]: red rises to the east, green to the north."""
    x, y = np.moveaxis(np.asarray(places, dtype=float), -1, 0)
    return np.stack([40 + 0.35 * (x + 150), 40 + 0.5 * (y + 100), np.full_like(x, 90.0)], -1)


def environment(background, **more):
    given = {'bounds': BOUNDS, 'origin': ORIGIN, 'background': background, **more}
    return EnvironmentSettings.model_validate(given)


def written(folder, kind):
    """Return the environment of a picture of a kind."""
    name = folder / ('map.tif' if kind in CRS else 'map.png')
    if kind in CRS:
        import rasterio
        from rasterio.transform import from_bounds
        from rasterio.warp import transform

        corners = np.array([[x, y] for x in (-150.0, 350.0) for y in (-100.0, 300.0)])
        degrees = geodetic(corners, OriginSettings(**ORIGIN))
        east, north = map(np.array, transform('EPSG:4326', kind, degrees[:, 1], degrees[:, 0]))
        limits = east.min(), north.min(), east.max(), north.max()
        grid = from_bounds(*limits, 500, 400)
        columns, rows = np.meshgrid(np.arange(500) + 0.5, np.arange(400) + 0.5)
        places = transform(kind, 'EPSG:4326', *(np.ravel(item) for item in grid * (columns, rows)))
        from maasi_filter.geometry.geodesy import to_map

        at = to_map(np.stack(places, axis=1), OriginSettings(**ORIGIN)).reshape(400, 500, 2)
        with rasterio.open(
            name,
            'w',
            driver='GTiff',
            width=500,
            height=400,
            count=3,
            dtype='uint8',
            crs=kind,
            transform=grid,
        ) as file:
            file.write(np.moveaxis(colour_of(at).clip(0, 255).astype(np.uint8), -1, 0))
        return environment(str(name))
    x, y = np.meshgrid(-150 + np.arange(500) + 0.5, 300 - np.arange(400) - 0.5)
    pixels = colour_of(np.stack([x, y], axis=-1))
    cv2.imwrite(str(name), pixels[:, :, ::-1].astype(np.uint8))
    if kind == 'extent':
        return environment({'file': str(name), 'extent': [[-150, 350], [-100, 300]]})
    if kind == 'world_metres':
        world = [1.0, 0.0, 0.0, -1.0, -149.5, 299.5]
    else:
        degrees = geodetic(np.array([[-149.5, 299.5], [349.5, -99.5]]), OriginSettings(**ORIGIN))
        (north, west, _), (south, east, _) = degrees
        world = [(east - west) / 499, 0.0, 0.0, (south - north) / 399, west, north]
    name.with_suffix('.pgw').write_text('\n'.join(map(repr, map(float, world))))
    return environment(str(name))


@pytest.mark.parametrize('kind', [*CRS, 'extent', 'world_metres', 'world_degrees'])
def test_a_picture_lies_where_its_file_says(tmp_path, kind):
    shown = background_of(written(tmp_path, kind))
    data = np.frombuffer(base64.b64decode(shown.data), np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    low, high = np.array(shown.bounds).T
    for place in np.random.default_rng(1).uniform(*np.transpose(BOUNDS), (40, 2)):
        column, row = ((place - (low[0], high[1])) / (high - low) * (1, -1)) * pixels.shape[1::-1]
        blue, green, red, *alpha = pixels[int(row), int(column)].tolist()
        assert not alpha or alpha[0] == 255
        assert [red, green, blue] == pytest.approx(colour_of(place), abs=9)


def test_what_cannot_be_placed_is_refused_by_name_with_what_to_do(tmp_path):
    written(tmp_path, 'extent')
    plain = str(tmp_path / 'map.png')
    (tmp_path / 'text.png').write_text('no picture')
    far = {'file': plain, 'extent': [[5000, 6000], [0, 100]]}
    for background, words in (
        (plain, 'has no coordinates; allowed are a GeoTIFF, an image with a world file'),
        (far, 'does not overlap'),
        (str(tmp_path / 'none.png'), 'No such file'),
        (str(tmp_path / 'text.png'), 'cannot identify'),
    ):
        (problem,) = background_problems(environment(background))
        assert problem.startswith('environment.background: ') and words in problem
    (tmp_path / 'map.pgw').write_text('1 2 3')
    (problem,) = background_problems(environment(plain))
    assert 'map.pgw: ' in problem
    (problem,) = background_problems(
        EnvironmentSettings(
            bounds=BOUNDS, background={'file': written(tmp_path, CRS[0]).background.file}
        )
    )
    assert 'needs environment.origin' in problem
    with pytest.raises(ValidationError, match='lower < upper'):
        environment({'file': plain, 'extent': [[1, 0], [0, 1]]})
    assert not list(background_problems(environment({})))


def test_the_page_has_it_under_the_map_and_asks_nobody(chromium, tmp_path):
    field = load_mission('field').scenario
    content = field.content()
    image = np.full((60, 80, 3), (30, 60, 200), np.uint8)
    cv2.imwrite(str(tmp_path / 'map.png'), image)
    extent = [[-300, 300], [-250, 250]]
    content['environment']['background'] = {'file': str(tmp_path / 'map.png'), 'extent': extent}
    scene = scene_of('field', Scenario.model_validate(content))
    with chromium() as shown:
        shown.show(scene)
        shown.until('maasi.map.background.image?.complete')
        shown.settle()
        assert shown.colour(*shown.place(-60, 33)) == pytest.approx([200, 60, 30], abs=6)
        shown.page.click('button[data-layer=background]')
        shown.settle()
        assert shown.colour(*shown.place(-60, 33)) != pytest.approx([200, 60, 30], abs=40)
        # Latitude and longitude under the pointer need a cell of the map.
        grid = [0.0, 'map', '', [-200, -150, 0], [10, 10, 0], [41, 31, 1], 'z' * 41 * 31, 0.0]
        shown.show(scene, grid)
        words = shown.tip(-100, 50)
        expected = geodetic(np.array([[-100.0, 50.0]]), field.environment.origin)[0, :2]
        read = re.search(r'latitude ([\d.]+), longitude ([\d.]+)$', words).groups()
        assert list(map(float, read)) == pytest.approx(expected.tolist(), abs=1e-5)


def test_a_scenario_file_names_it_from_its_own_folder(tmp_path):
    cv2.imwrite(str(tmp_path / 'map.png'), np.zeros((4, 4, 3), np.uint8))
    text = (config_folder() / 'scenarios' / 'field.yaml').read_text(encoding='utf-8')
    text = text.replace(
        'area: field.geojson', 'background: map.png\n  bounds: [[-200, 200], [-150, 150]]'
    )
    (tmp_path / 'own.yaml').write_text(text)
    with pytest.raises(ValueError, match=r'background: .*map\.png: has no coordinates'):
        load_scenario(tmp_path / 'own.yaml')
