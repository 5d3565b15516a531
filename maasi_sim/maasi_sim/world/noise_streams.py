"""Random streams keyed by seed, robot, step and purpose: the same in any process and any order."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def noise_stream(
    seed: int, robot: str = '', step: int = 0, purpose: str = ''
) -> np.random.Generator:
    """
    Return the generator of one robot's noise for one purpose at one step.

    Parameters
    ----------
    seed : int
        Of the run, not negative.
    robot : str
        Name of the robot; empty for noise of the world.
    step : int
        Discrete step k, not negative.
    purpose : str
        Such as 'camera' or 'odometry'.

    Returns
    -------
    numpy.random.Generator
        Independent of the streams of other keys; equal for equal keys, in every process.
    """
    for name, value in (('seed', seed), ('step', step)):
        if value < 0:
            raise ValueError(f'{name}: got {value}, allowed are whole numbers of at least 0')
    key = (seed, crc32(robot.encode()), step, crc32(purpose.encode()))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))
