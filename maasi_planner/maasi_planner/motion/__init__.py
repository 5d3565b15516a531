"""Motion models: controller, prediction and body of robots."""

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
        Area of the robot, in which its paths stay; default: unlimited.
    radius : float
        Radius of the robot, metres.
    """
    model: MotionModel = MOTIONS.load(settings.model)(settings, area, radius)
    return model
