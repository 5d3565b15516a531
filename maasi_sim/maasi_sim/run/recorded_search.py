"""Search in a recording of robots' cameras and poses, with one measurement per sensor period."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.calibration.bag_reader import BagError, BagReader
from maasi_drivers.calibration.recorded_robot import USED, RecordedRobot
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.vision.marker_detector import read_markers
from maasi_filter.geometry.area import Area
from maasi_filter.make_filter import make_filter
from maasi_filter.records import AgentMeasurement
from maasi_filter.wording import counted, point
from maasi_planner.coordinator import Coordinator
from maasi_sim.run.ending import DONE
from maasi_sim.run.facts import Measured, RobotAt, Updated
from maasi_sim.run.log import RunEnd, RunLog
from maasi_sim.run.run_folder import make_folder, write_text
from maasi_sim.run.run_options import Options
from maasi_sim.run.targets.report import explored_after
from maasi_sim.run.targets.report_sheet import report_pdf
from maasi_sim.run.targets.tables import csv_text, found_rows
from maasi_sim.run.view.page_file import REPLAY, write_replay
from maasi_sim.run.view.recording import event_log
from maasi_sim.scenario.layering import Key, ScenarioError, print_warnings_plainly
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import Scenario, planner_settings

_UNIX = 1e9  # stamps above are Unix times, below those of a simulation [s]
Placed = tuple[StampedPose, AgentMeasurement]  # pose of a robot and its measurement there


def search_recording(options: Options) -> int:
    """Search a recording, print and write the found targets, and return the exit code."""
    assert options.replay is not None
    print_warnings_plainly()
    seed, bag, topics = options.seed, options.replay, dict(options.remap)
    overrides: dict[str, tuple[Key, object]] = {} if seed is None else {'--seed': (('seed',), seed)}
    loaded = load_scenario(options.scenario, overrides)
    recorded = [
        item for name in loaded.names() for item in recorded_measurements(loaded, name, bag, topics)
    ]
    log, explored = search_measurements(loaded, recorded)
    found = log.found_targets
    folder = make_folder(options.out, '_replay')
    origin = loaded.environment.origin
    rows = found_rows(found, np.zeros((0, loaded.dimension)), [], origin)
    write_text(folder / 'found_targets.csv', csv_text(rows, loaded.dimension, origin))
    write_replay(event_log(log, bag.name), folder / REPLAY)
    first, last = (1e-9 * pick(place.stamp for place, _ in recorded) for pick in (min, max))
    # Stamps of robots without a simulation are Unix times.
    began = first if first > _UNIX else None
    log.close(RunEnd('end of the recording', last - first, 0.0, (), began), last - first)
    write_text(folder / 'report.pdf', report_pdf(log, explored_after(log)))
    for target in found:
        print(
            f'target {target.id} of {target.robot} at {point(target.position)} m, '
            f'after {target.time:.1f} s'
        )
    print(
        f'{counted(len(recorded), "measurement")}: {counted(len(found), "target")} found, '
        f'{100.0 * explored:.0f} % explored; '
        f'results in {folder}'
    )
    return DONE


def recorded_measurements(
    scenario: Scenario, name: str, bag: Path, remap: Mapping[str, str]
) -> list[Placed]:
    """Return the measurements of a robot from its recorded images, as its driver makes them."""
    robot = scenario.robots[name]
    if robot.camera is None:
        raise ScenarioError(
            f'robots.{name}.camera: read nothing, allowed with --replay are robots with a camera'
        )
    settings = DriverSettings(
        environment=scenario.environment,
        start=robot.start,
        yaw=robot.yaw,
        sensor=robot.sensor,
        camera=robot.camera,
    )
    with BagReader(bag, remap) as reader:
        there = any(reader.counts.get(f'/{name}{image}') for image in USED['images'])
    # A robot that is alone in its scenario may have any namespace, or none.
    space = name if there or len(scenario.robots) > 1 else None
    try:
        recorded = RecordedRobot(bag, settings, space, 'images', remap=remap)
        if not recorded.records('/camera/camera_info'):
            print(f'{name}: no camera_info recorded: using the camera of the scenario')
        detector, sensor = recorded.detector(), robot.sensor.build(name, scenario.dimension)
        found: list[Placed] = []
        for place, image in recorded.images(robot.sensor.period):
            seen = read_markers(image, place, detector, sensor)
            known = place.covariance[:3, :3]
            values = seen.values, seen.covariances, len(found), known, seen.labels
            found.append((place, AgentMeasurement(name, place.pose, sensor, *values)))
    except ValueError as error:
        raise BagError(str(error)) from error
    if recorded.recovered:
        print(f'warning: {recorded.recovered}')
    if not found:
        raise BagError(
            f'{bag}: {name}: cannot use any of {recorded.left_out} images: {recorded.why}'
        )
    poses = recorded.pose_source()
    print(
        f'{name}: {counted(len(found), "image")} used with poses of {poses}, '
        f'{recorded.left_out} skipped'
    )
    if recorded.left_out:
        print(f'{name}: skipped images: {recorded.why}')
    return found


def search_measurements(scenario: Scenario, recorded: list[Placed]) -> tuple[RunLog, float]:
    """Feed a filter with measurements by stamp; return the log and the explored share."""
    common = {'step': scenario.step, 'seed': scenario.seed, 'lockstep': True}
    coordinator = Coordinator(planner_settings(scenario, scenario.names(), common))
    generator = np.random.default_rng(scenario.seed)
    search_filter = make_filter(scenario.filter, Area(scenario.environment), generator)
    log = RunLog(scenario, scenario.seed)
    recorded = sorted(recorded, key=lambda item: (item[0].stamp, item[1].robot))
    first, before = recorded[0][0].stamp, 0
    for place, measurement in recorded:
        time, name = 1e-9 * (place.stamp - first), measurement.robot
        step = round(time / scenario.step)
        result = search_filter.step([measurement], step - before, time)
        before = step
        coordinator.absorb({name: place.pose}, result.clusters)
        log.add(RobotAt(time, name, (*place.pose.position.tolist(), place.pose.yaw)))
        found = search_filter.found_targets if result.found_changed else None
        log.add(Measured.of(time, measurement))
        members = [(name, measurement.index)]
        expected, clusters = result.expected_number, result.clusters
        log.add(Updated(time, step, '', members, found, expected, clusters))
        log.add_map(time, '', coordinator.exploration, now=False)
    return log, coordinator.exploration.explored_fraction()
