from glob import glob

from setuptools import find_packages, setup

setup(
    name='maasi_drivers',
    version='0.1.0',
    packages=find_packages(),
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/maasi_drivers']),
        ('share/maasi_drivers', ['package.xml']),
        ('share/maasi_drivers/launch', glob('launch/*.launch.py')),
    ],
    python_requires='>=3.10,<3.15',
    install_requires=[
        'maasi_filter',
        'maasi_planner',
        'numba>=0.59',
        'numpy>=1.26,<3',
        'opencv-python-headless>=4.7.0.72',
        'pydantic>=2.7',
        'PyYAML>=6.0.1',
        'scipy>=1.11.4',
        'shapely>=2.0.3',
    ],
    extras_require={
        'calibration': ['rosbags>=0.11.5'],
        'mambo': ['pyparrot>=1.5.20', 'zeroconf>=0.131'],
        'mavlink': ['pymavlink>=2.4.41'],
        'test': ['pytest>=7.4'],
    },
    zip_safe=True,
    maintainer='The MAASI developers',
    maintainer_email='maasi@users.noreply.github.com',
    description='One node per robot: sensor to detections, waypoint to motion',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'mambo_driver = maasi_drivers_entry:mambo_driver',
            'turtlebot_driver = maasi_drivers_entry:turtlebot_driver',
            'plugin_driver = maasi_drivers_entry:plugin_driver',
            'ranging_driver = maasi_drivers_entry:ranging_driver',
            'camera_driver = maasi_drivers_entry:camera_driver',
            'measurement_feed_sender = maasi_drivers_entry:measurement_feed_sender',
            'mavlink_driver = maasi_drivers_entry:mavlink_driver',
            'mavlink_camera_driver = maasi_drivers_entry:mavlink_camera_driver',
            'calibrate_sensor = maasi_drivers_entry:calibrate_sensor',
            'mambo_onboard_driver = maasi_drivers_entry:mambo_onboard_driver',
            'team_command = maasi_drivers_entry:team_command',
            'measure_mambo = maasi_drivers_entry:measure_mambo',
            'guard_node = maasi_drivers_entry:guard_node',
        ]
    },
)
