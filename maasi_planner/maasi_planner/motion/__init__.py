"""Motion models: each has its controller, its prediction and its body."""

from maasi_filter.geometry.area import Area
from maasi_planner.motion.base import Body, MotionModel, RobotState, Trajectories
from maasi_planner.motion.models import ConstantSpeed, Mambo, Quadrotor, Unicycle
from maasi_planner.settings import MOTIONS, MotionSettings

__all__ = [
    'Body',
    'ConstantSpeed',
    'Mambo',
    'MotionModel',
    'Quadrotor',
    'RobotState',
    'Trajectories',
    'Unicycle',
    'make_motion',
]


def make_motion(
    settings: MotionSettings, area: Area | None = None, radius: float = 0.0
) -> MotionModel:
    """Return the motion model that `settings.model` names.

    Parameters
    ----------
    settings : MotionSettings
        Model, limits and controller.
    area : Area, optional
        Where it may go: its ways lead around what is not in it; none: anywhere.
    radius : float
        Of the robot, metres.
    """
    model: MotionModel = MOTIONS.load(settings.model)(settings, area, radius)
    return model
