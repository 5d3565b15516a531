"""Drawing an area and keep-outs on the page: what is saved is what the next run reads."""

import contextlib

import numpy as np
import pytest
import shapely

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings
from maasi_sim.run.view.scene import zones_of
from maasi_sim.run.view.server import Hub, ViewServer

OLD = {'area': [[0, 0], [400, 0], [400, 300], [0, 300]], 'keep_outs': ['90 100 30']}
AREA = [[20, 30], [380, 20], [390, 260], [200, 280], [30, 250]]
KEEP_OUTS = [[[100, 100], [160, 110], [120, 170]], [[250, 60], [330, 60], [330, 120], [250, 110]]]
ORIGINS = [
    None,
    OriginSettings(latitude=46.6, longitude=-9.9, altitude=1800.0),
    OriginSettings(latitude=-70.2, longitude=179.999),
]


def scene(bounds, **more):
    return {'name': 'valley', 'robots': {}, 'bounds': bounds, **more}


def click(shown, corner, twice=False):
    """Click at a place, and return the place of the pixel, which is what is drawn."""
    x, y = map(round, shown.place(*corner))
    place = shown.page.evaluate(f'maasi.camera.place({x}, {y})')
    box = shown.page.locator('#map').bounding_box()
    (shown.page.mouse.dblclick if twice else shown.page.mouse.click)(box['x'] + x, box['y'] + y)
    shown.settle()
    return place


def draw(shown, name, ring, twice):
    """Draw a ring that is closed by a double click, or by a click on its first corner."""
    shown.page.click(f'button[data-draw={name}]')
    shown.settle()
    places = [click(shown, corner) for corner in ring[:-1]] + [click(shown, ring[-1], twice)]
    if not twice:
        click(shown, ring[0])
    return places


def saved(shown, folder):
    with shown.page.expect_download() as download:
        shown.page.click('button[data-draw=save]')
    file = folder / download.value.suggested_filename
    download.value.save_as(file)
    return file


def same(shape, ring):
    """Return whether a polygon has the corners of a ring, to a millimetre."""
    given = shapely.Polygon(ring)
    return shape.hausdorff_distance(given) < 1e-3 and shape.geom_type == 'Polygon'


@pytest.mark.parametrize('origin', ORIGINS)
def test_what_is_drawn_and_saved_is_what_the_next_run_reads(chromium, tmp_path, origin):
    given = EnvironmentSettings.model_validate(OLD)
    facts = {'zones': zones_of(Area(given)), 'origin': origin and origin.model_dump()}
    with chromium(accept_downloads=True) as shown:
        shown.show(scene(given.bounds, **facts))
        # Nothing is drawn: the run's own.
        own = Area(EnvironmentSettings(area=str(saved(shown, tmp_path))))
        assert origin or same(own.shapes['area'][0], OLD['area'])
        area = draw(shown, 'area', AREA, twice=True)
        drawn = [draw(shown, 'keep_out', ring, bool(n)) for n, ring in enumerate(KEEP_OUTS)]
        assert 'New area, 3 keep-out zones' in shown.page.inner_text('#drawing')
        file = saved(shown, tmp_path)
    # Without an origin in the scenario the map is where it was.
    read = Area(EnvironmentSettings(area=str(file)))
    assert read.settings.origin == origin
    old, *new = read.shapes['keep_out']
    assert old.area == pytest.approx(np.pi * 30.0**2, rel=1e-3)
    assert all(map(same, [*read.shapes['area'], *new], [area, *drawn]))
    assert len(new) == 2 and len(read.shapes['area']) == 1


def test_a_ring_that_is_wrong_is_said_and_nothing_is_lost(chromium, tmp_path):
    # The page of a run that has not begun, in space.
    server = ViewServer(Hub(scene([[0, 400], [0, 300], [0, 50]])), 0)
    with contextlib.closing(server), chromium(accept_downloads=True) as shown:
        page = shown.page
        page.goto(f'http://127.0.0.1:{server.port}/')
        shown.until('maasi.log.bounds.length === 3 && maasi.drawn > 0')
        page.click('#space')
        shown.settle()
        assert page.is_hidden('#drawing')
        # Two corners, then sides that cross.
        crossed = draw(shown, 'keep_out', [[50, 50], [300, 200]], twice=True)
        assert 'at least 3 corners' in page.inner_text('#drawing')
        crossed += [click(shown, [300, 50]), click(shown, [50, 200], twice=True)]
        assert 'crosses another' in page.inner_text('#drawing')
        page.click('button[data-draw=save]')
        assert 'Not saved' in page.inner_text('#drawing')
        assert page.evaluate('maasi.drawing.corners') == [
            pytest.approx(corner, abs=1e-4) for corner in crossed
        ]
        page.click('button[data-draw=undo]')
        crossed[-1:] = [click(shown, [150, 40], twice=True)]
        values = {'area': str(saved(shown, tmp_path)), 'altitude': [0, 50]}
        assert 'altitude: [0, 50]' in page.inner_text('#drawing')
        read = Area(EnvironmentSettings.model_validate(values))
        assert read.bounds.tolist() == [[0, 400], [0, 300], [0, 50]]
        assert same(read.shapes['keep_out'][0], crossed)
        # A click chooses robots again; the last shape can be taken back, the area of the run stays.
        click(shown, [350, 250])
        for _ in range(3):
            page.click('button[data-draw=undo]')
        assert page.evaluate('maasi.drawing.kept.map((item) => item.kind)') == ['area']
