"""Settings of the planner `maasi`."""

from typing import Any, ClassVar, Literal

from pydantic import Field

from maasi_planner.settings import JointSettings, NotNegative, PlannerSettings


class InformationSettings(JointSettings):
    """Settings of `maasi` with the objective `information`, and of `auto`."""

    objective: Literal['paper', 'information'] = Field(
        'information',
        description='Terms T and E: those of MAASI 2024 (eq. 17 to 22, 26 to 32), or information '
        'gain and expected new targets of all measurements of the team together',
    )
    alpha: NotNegative = Field(0.5, description='Weight of target refinement T [1]')
    beta: NotNegative = Field(1.0, description='Weight of exploration E [1]')
    control_weight: NotNegative = Field(1e-6, description='Weight of the control cost C [1]')
    normalisation: Literal['steps', 'distance'] = Field(
        'steps',
        description='J is divided by the number of steps K, or by the length of the trajectory in '
        'metres',
    )
    measure_at_arrival: bool = Field(
        True, description='Whether T and E count the measurement at the waypoint itself'
    )
    count_present: bool = Field(
        False,
        description='Whether T and E count the measurement at the present position, which all '
        'candidates share',
    )
    own_measurement: bool = Field(
        True,
        description='Whether e in E includes the measurement at which it is evaluated, as in eq. '
        '21 and 22 of MAASI 2024; with pi = 1 around the robot, E is then 0',
    )
    extension: Literal['measuring', 'silent'] = Field(
        'measuring',
        description='Whether robots that wait at the end of a predicted trajectory continue to '
        'measure',
    )
    cluster_candidates: bool = Field(True, description='Whether cluster centres are candidates too')
    exploration_nodes: int = Field(
        1000, ge=8, le=1_000_000, description='Largest number of nodes for expected new targets [1]'
    )
    pair_budget: int = Field(
        1000,
        ge=0,
        description='Largest number of evaluated moves of two robots when up to 5 choose in turn '
        '[1]',
    )

    @classmethod
    def chosen_by(cls, values: Any) -> type[PlannerSettings]:
        """See `PlannerSettings.chosen_by`."""
        return PaperSettings if values.get('objective') == 'paper' else InformationSettings


def _like(name: str, default: Any) -> Any:
    return Field(default, description=InformationSettings.model_fields[name].description)


class PaperSettings(InformationSettings):
    """Settings of `maasi` with the objective `paper`, and of `auto`."""

    stops: ClassVar[bool] = True

    objective: Literal['paper', 'information'] = _like('objective', 'paper')
    beta: NotNegative = _like('beta', 0.5)
    control_weight: NotNegative = _like('control_weight', 1.0)
    measure_at_arrival: bool = _like('measure_at_arrival', False)
    count_present: bool = _like('count_present', True)
    cluster_candidates: bool = _like('cluster_candidates', False)
