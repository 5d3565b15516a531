"""The scene of a run: its constant parts, from its scenario or messages."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely.geometry.base import BaseGeometry

from maasi_drivers.agent.flight_rules import flight_volume
from maasi_drivers.settings.vehicles import FlightSettings
from maasi_filter.geometry.area import Area
from maasi_filter.settings import DETECTIONS
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.buildings.settings import FACES
from maasi_planner.objective.settings import InformationSettings
from maasi_planner.settings import PlannerSettings
from maasi_sim.run.buildings.scenario import NAME as BUILDINGS
from maasi_sim.run.buildings.scenario import CuboidScenario
from maasi_sim.run.scores import scoring_radius
from maasi_sim.run.view.event_log import Scene
from maasi_sim.scenario.background import background_of
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.schema import RobotSettings, Scenario


def empty_scene(name: str = '') -> Scene:
    """Return the scene of a run before anything is known."""
    return {'name': name, 'robots': {}}


def scene_of(name: str, scenario: BaseScenario, seed: int | None = None) -> Scene:
    """Return the scene of a scenario; seed: that of the run, default the scenario's."""
    seed = scenario.seed if seed is None else seed
    scene: Scene = {
        'name': name,
        'description': scenario.description,
        'seed': seed,
        'planner': scenario.planner.name,
        'step': scenario.step,
        'bounds': rounded(scenario.environment.array()),
        **_background(scenario),
    }
    if isinstance(scenario, CuboidScenario):
        return scene | _buildings(scenario)
    assert isinstance(scenario, Scenario)
    area, truth = scenario.world(seed).area, np.asarray(scenario.world(seed).targets, dtype=float)
    return (
        scene
        | _prior(scenario)
        | {
            'obstacles': [
                [*map(float, obstacle.centre), obstacle.radius]
                for obstacle in scenario.environment.obstacles
                if obstacle.centre
            ],
            'zones': zones_of(area),
            # Searchable area seen from above [m^2].
            'ground': round(area.volume / float(np.prod(np.ptp(area.bounds[2:], axis=1))), 3),
            'origin': scenario.environment.origin and scenario.environment.origin.model_dump(),
            'robots': {name: _robot(scenario.robots[name], scenario) for name in scenario.names()},
            'targets': len(truth),
            'expected_targets': scenario.environment.expected_targets,
            **_objective(scenario.planner),
            'scoring_radius': scoring_radius(scenario, truth) if len(truth) else None,
            'scoring_order': scenario.scoring.order,
        }
    )


def _background(scenario: BaseScenario) -> Scene:
    try:
        picture = background_of(scenario.environment)
    except ValueError as error:
        return {'missing': f'cannot show the background: {error}'}
    return {} if picture is None else {'background': [*picture]}


def _prior(scenario: Scenario) -> Scene:
    """Return the prior on a grid (corner, step, shape, values), or nothing if it is uniform."""
    if not (scenario.environment.prior.polygons or scenario.environment.prior.raster):
        return {}
    area = Area(scenario.environment.without_keep_outs())
    unseen = UnexploredMap(area, scenario.filter.exploration_spacing)
    # At the resolution of the unexplored area.
    corner, step, likely = unseen.shown(prior=True)
    level = likely.reshape(*likely.shape[:2], -1)[:, :, 0]
    values = [float(f'{value:.3g}') for value in level.ravel()]
    return {'prior': [rounded(corner[:2]), rounded(step[:2]), [*level.shape], values]}


def zones_of(area: Area) -> list[dict[str, Any]]:
    """Return the shapes of an area: kind and rings [m, map], the outer ring first."""
    return [zone for kind, shapes in area.shapes.items() for zone in zones_as(kind, shapes)]


def zones_as(kind: str, shapes: Sequence[BaseGeometry]) -> list[dict[str, Any]]:
    """Return shapes of one kind, as `zones_of`."""
    return [
        {'kind': kind, 'rings': [rounded(shapely.get_coordinates(ring)) for ring in rings]}
        for rings in map(shapely.get_rings, shapely.get_parts(shapes))
    ]


def scene_of_facts(facts: Mapping[str, Any]) -> Scene:
    """Return the scene from a recording's own description of its run."""
    content = facts['scenario']
    buildings = content.get('planner', {}).get('name') == BUILDINGS
    model: type[BaseScenario] = CuboidScenario if buildings else Scenario
    known = {'command': facts['command']} if 'command' in facts else {}
    name, seed = str(facts.get('name', '')), facts.get('seed')
    return scene_of(name, model.model_validate(content), seed) | known


def rounded(values: ArrayLike) -> list[Any]:
    """Return an array as nested lists, rounded to 0.1 mm."""
    return list(np.round(np.asarray(values, dtype=float), 4).tolist())


def _objective(settings: PlannerSettings) -> Scene:
    """Return the terms of J, for planners whose objective is that of `PlannerSettings`."""
    # Planners that choose by equation (17).
    if settings.name == 'auto' or not isinstance(settings, InformationSettings):
        return {}
    weights = {
        'control': settings.control_weight,
        'alpha': settings.alpha,
        'beta': settings.beta,
        'per_distance': settings.normalisation == 'distance',
    }
    return {'objective': settings.objective, 'weights': weights}


def _robot(robot: RobotSettings, scenario: Scenario) -> dict[str, Any]:
    detection = robot.sensor.detection
    _, parameters = detection.build(scenario.dimension).kernel()
    view: dict[str, Any] = {'kind': detection.kind, 'turns': detection.frame == 'robot'}
    view['gain'] = float(parameters[0])
    if detection.kind == 'box':
        corners = {'lower': list(detection.lower), 'upper': list(detection.upper)}
        view |= corners | {'edge': detection.edge}
    elif detection.kind not in DETECTIONS.built_in:
        view['size'] = [1.0 / float(parameters[1])] * scenario.dimension
    else:
        view['size'] = list(detection.size)[: scenario.dimension]
    deviations = [float(value) for value in robot.sensor.noise.deviations(scenario.dimension)]
    fence = {}
    if robot.link != 'topics':
        # As its driver creates it.
        links = {'mambo_wifi': robot.mambo, 'mavlink': robot.mavlink}
        limits = links.get(robot.link, robot.platform) or FlightSettings()
        volume = flight_volume(Area(scenario.environment.bounds), robot, limits)
        fence = {'fence': rounded(volume.limits)}
    return {
        'type': robot.type,
        'description': robot.description,
        'radius': robot.radius,
        'flies': robot.flies,
        'clearance': robot.motion.clearance,
        'view': view,
        'deviations': [*deviations, 0.0][:3],
        **fence,
        'camera': robot.camera and robot.camera.model_dump(exclude={'segmentation'}),
    }


def _buildings(scenario: CuboidScenario) -> Scene:
    mission = scenario.mission()
    return {
        'objects': rounded(mission.objects),
        'blocks': rounded(mission.obstacles),
        'cuboids': rounded(mission.boxes),
        # Part of a face for each cuboid: object, face number, sides.
        'cells': [
            [cell.target, FACES.index(cell.face), rounded(cell.sides())] for cell in mission.cells
        ],
        'robots': {
            name: {
                'type': robot.type,
                'description': robot.description,
                'radius': 1.0,
                'reach': scenario.planner.communication_range,
            }
            for name, robot in scenario.robots.items()
        },
    }
