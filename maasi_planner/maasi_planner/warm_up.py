"""Compiles every kernel of a decision, or loads it from the cache."""

import numpy as np

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.detection import BoxDetection, ExponentialDetection
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.measurement_schedule import MeasurementSchedule
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.objective.joint_search import PAIRS_LIMIT
from maasi_planner.planners import make_planner
from maasi_planner.settings import MotionSettings, planner_settings
from maasi_planner.team import RobotView, TeamView


def _decide(team: TeamView) -> None:
    for settings in (
        planner_settings(objective='paper'),
        planner_settings(objective='information'),
        planner_settings(objective='information', enumeration_limit=1),
    ):
        make_planner('maasi', settings).decide(team)
    make_planner('mutual_information').decide(team)
    tour = make_planner('tour')
    for _ in range(2):
        tour.decide(team)
    last = team.robots[team.names()[-1]]
    last.planning = False
    start = np.array(last.state.pose.position)
    last.remaining_path = np.stack([start, start + 0.1])
    for settings in (planner_settings(objective='paper'), planner_settings()):
        make_planner('maasi', settings).decide(team)
    view = team.robots[team.names()[0]]
    settings = planner_settings(measurement='event')
    schedule = MeasurementSchedule(view.motion, view.sensor, view.period_steps, settings)
    schedule.is_of_use(view.state.pose, team.clusters, team.exploration)
    team.exploration.update(view.sensor.detection, view.state.pose)


def warm_up() -> None:
    """Take small decisions of every kind, so that the first real one does not compile."""
    zone = {'centre': [1.0, 1.0], 'radius': 0.1}
    bounds = [[0.0, 2.0], [0.0, 2.0]]
    area = Area(EnvironmentSettings.model_validate({'bounds': bounds, 'obstacles': [zone]}))
    for dimension, models in ((2, ('mambo', 'unicycle')), (3, ('constant_speed', 'quadrotor'))):
        exploration = UnexploredMap(np.array([[0.0, 2.0]] * dimension), 0.25)
        clusters = [Cluster(np.full(dimension, 0.6), 0.01 * np.eye(dimension), 0.1, 0.5)]
        noise = np.diag([0.02, 0.05, 0.05][:dimension]) ** 2
        size = [0.2] * dimension
        for detection in (ExponentialDetection(0.98, size), BoxDetection([-0.2] * 2, [0.2] * 2)):
            robots = {}
            for index, model in enumerate(models):
                settings = MotionSettings(model=model, speed=0.4)
                motion = make_motion(settings, area, 0.05)
                state = RobotState.at_rest([0.2 + index, 0.2, 0.3])
                motion.body(state).step(motion.command(state, [0.5, 0.5, 0.3]), 0.05)
                robots[f'{index}'] = RobotView(
                    state=state,
                    candidates=np.array([[0.5, 1.5, 0.3], [1.5, 0.5, 0.3]]),
                    motion=motion,
                    sensor=Sensor('warm', detection, noise),
                    period_steps=5,
                )
            team = TeamView(0, 0.05, robots, clusters, exploration)
            _decide(team)
            if dimension == 2:
                # Over terrain, too.
                over = UnexploredMap(exploration.bounds, 0.25)
                over.area.terrain = Terrain(np.zeros((2, 2)), [0.0, 0.0], [2.0, 2.0])
                for name in ('maasi', 'tour'):
                    make_planner(name).decide(TeamView(0, 0.05, robots, clusters, over))
            # Large teams have separate kernels.
            view = team.robots['0']
            many = {f'{index}': view for index in range(PAIRS_LIMIT + 1)}
            for objective in ('paper', 'information'):
                large = TeamView(0, 0.05, many, clusters, exploration)
                make_planner('maasi', planner_settings(objective=objective)).decide(large)
