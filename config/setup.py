from glob import glob

from setuptools import setup

setup(
    name='maasi_config',
    version='0.1.0',
    packages=[],
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/maasi_config']),
        ('share/maasi_config', ['package.xml']),
        ('share/maasi_config/robots', glob('robots/*.yaml')),
        ('share/maasi_config/scenarios', glob('scenarios/*.*')),
        ('share/maasi_config/foxglove', glob('foxglove/*.json')),
        ('share/maasi_config/rviz', glob('rviz/*.rviz')),
    ],
    python_requires='>=3.10,<3.15',
    extras_require={'test': ['pytest>=7.4', 'PyYAML>=6.0.1']},
    zip_safe=True,
    maintainer='The MAASI developers',
    maintainer_email='maasi@users.noreply.github.com',
    description='Robot types, scenarios and RViz configurations of MAASI',
    license='Apache-2.0',
)
