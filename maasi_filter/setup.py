from glob import glob

from setuptools import find_packages, setup

setup(
    name='maasi_filter',
    version='0.1.0',
    packages=find_packages(),
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/maasi_filter']),
        ('share/maasi_filter', ['package.xml']),
        ('share/maasi_filter/launch', glob('launch/*.launch.py')),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    maintainer='The MAASI developers',
    maintainer_email='maasi@users.noreply.github.com',
    description=(
        'What the team believes: sensors, exploration and the particle PHD filter, with '
        'the filter node'
    ),
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'filter_node = maasi_entry:maasi_filter.filter_node',
        ],
    },
)
