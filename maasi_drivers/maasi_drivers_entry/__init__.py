"""Console scripts of maasi_drivers."""

from functools import partial

from maasi_filter_entry import run

mambo_driver = partial(run, 'maasi_drivers.drivers:mambo_driver')
turtlebot_driver = partial(run, 'maasi_drivers.drivers:turtlebot_driver')
plugin_driver = partial(run, 'maasi_drivers.plugin_driver:main')
ranging_driver = partial(run, 'maasi_drivers.drivers:ranging_driver')
camera_driver = partial(run, 'maasi_drivers.drivers:camera_driver')
measurement_feed_sender = partial(run, 'maasi_drivers.measurement_feed_sender:main', ros=False)
mavlink_driver = partial(run, 'maasi_drivers.drivers:mavlink_driver')
mavlink_camera_driver = partial(run, 'maasi_drivers.drivers:mavlink_camera_driver')
calibrate_sensor = partial(run, 'maasi_drivers.calibrate_sensor:main')
mambo_onboard_driver = partial(run, 'maasi_drivers.drivers:mambo_onboard_driver')
team_command = partial(run, 'maasi_drivers.team_command:main')
measure_mambo = partial(run, 'maasi_drivers.measure_mambo:main', ros=False)
guard_node = partial(run, 'maasi_drivers.guard_node:main')
