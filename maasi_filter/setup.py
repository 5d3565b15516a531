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
    python_requires='>=3.10,<3.15',
    install_requires=[
        'numba>=0.59',
        'numpy>=1.26,<3',
        'Pillow>=10.2',
        'pydantic>=2.7',
        'pymap3d>=2.9',
        'PyYAML>=6.0.1',
        'scipy>=1.11.4',
        'shapely>=2.0.3',
        'typing_extensions>=4.10',
    ],
    extras_require={
        'geo': ['pyogrio>=0.10', 'rasterio>=1.4'],
        'test': ['hypothesis>=6.98', 'pytest>=7.4'],
    },
    zip_safe=True,
    maintainer='The MAASI developers',
    maintainer_email='maasi@users.noreply.github.com',
    description=(
        'Particle PHD and Poisson multi-Bernoulli filters for target search, sensor models '
        'and the exploration map; the filter node'
    ),
    license='Apache-2.0',
    entry_points={'console_scripts': ['filter_node = maasi_filter_entry:filter_node']},
)
