from glob import glob

from setuptools import find_packages, setup

setup(
    name='maasi_sim',
    version='0.1.0',
    packages=find_packages(),
    package_data={
        'maasi_sim.experiments': ['papers/*'],
        'maasi_sim.run': ['discovery.xml', 'discovery_many.xml', 'report.schema.json'],
        'maasi_sim.run.view': ['page/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/maasi_sim']),
        ('share/maasi_sim', ['package.xml']),
        ('share/maasi_sim/launch', glob('launch/*.launch.py')),
    ],
    python_requires='>=3.10,<3.15',
    install_requires=[
        'maasi_config',
        'maasi_drivers',
        'maasi_filter',
        'maasi_planner',
        'numba>=0.59',
        'numpy>=1.26,<3',
        'opencv-python-headless>=4.7.0.72',
        'pydantic>=2.7',
        'PyYAML>=6.0.1',
        'rosbags>=0.11.5',
        'scipy>=1.11.4',
        'shapely>=2.0.3',
    ],
    extras_require={
        'experiments': ['distributed>=2024.1', 'matplotlib>=3.8'],
        'geo': ['maasi_filter[geo]', 'rasterio>=1.4'],
        'reports': ['matplotlib>=3.8', 'Pillow>=10.2'],
        'runs': ['matplotlib>=3.8', 'setproctitle>=1.3.3'],
        'test': ['pytest>=7.4'],
    },
    zip_safe=True,
    maintainer='The MAASI developers',
    maintainer_email='maasi@users.noreply.github.com',
    description='Stands in for the hardware; the whole search in one process; scenarios, reports',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'cuboid_sim_node = maasi_sim_entry:cuboid_sim_node',
            'sim_node = maasi_sim_entry:sim_node',
            'fake_mambo = maasi_sim_entry:fake_mambo',
            'fake_mavlink_vehicle = maasi_sim_entry:fake_mavlink_vehicle',
            'view_node = maasi_sim_entry:view_node',
            'compare = maasi_sim_entry:compare',
            'run_scenario = maasi_sim_entry:run_scenario',
        ]
    },
)
