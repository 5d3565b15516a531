"""Console scripts of maasi_drivers."""

from functools import partial

from maasi_filter_entry import run

mambo_driver = partial(run, 'maasi_drivers.drivers:MamboDriver')
turtlebot_driver = partial(run, 'maasi_drivers.drivers:TurtlebotDriver')
plugin_driver = partial(run, 'maasi_drivers.plugin_driver:main')
ranging_driver = partial(run, 'maasi_drivers.drivers:RangingDriver')
camera_driver = partial(run, 'maasi_drivers.drivers:CameraDriver')
measurement_feed_sender = partial(run, 'maasi_drivers.measurement_feed_sender:main', ros=False)
mavlink_driver = partial(run, 'maasi_drivers.drivers:MavlinkDriver')
mavlink_camera_driver = partial(run, 'maasi_drivers.drivers:MavlinkCameraDriver')
calibrate_sensor = partial(run, 'maasi_drivers.calibrate_sensor:main')
mambo_onboard_driver = partial(run, 'maasi_drivers.drivers:MamboOnboardDriver')
team_command = partial(run, 'maasi_drivers.team_command:main')
measure_mambo = partial(run, 'maasi_drivers.measure_mambo:main', ros=False)
guard_node = partial(run, 'maasi_drivers.guard_node:GuardNode')
