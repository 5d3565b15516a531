from glob import glob

from setuptools import find_packages, setup

setup(
    name='maasi_planner',
    version='0.1.0',
    packages=find_packages(),
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/maasi_planner']),
        ('share/maasi_planner', ['package.xml']),
        ('share/maasi_planner/launch', glob('launch/*.launch.py')),
    ],
    python_requires='>=3.10,<3.15',
    install_requires=[
        'maasi_filter',
        'numba>=0.59',
        'numpy>=1.26,<3',
        'pydantic>=2.7',
        'scipy>=1.11.4',
        'shapely>=2.0.3',
    ],
    extras_require={'test': ['pytest>=7.4']},
    zip_safe=True,
    maintainer='The MAASI developers',
    maintainer_email='maasi@users.noreply.github.com',
    description=(
        'Planners, motion models and objectives for multi-robot target search; the planner node'
    ),
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'cuboid_planner_node = maasi_planner_entry:cuboid_planner_node',
            'planner_node = maasi_planner_entry:planner_node',
        ]
    },
)
