"""Settings of the planner node of one robot that searches buildings."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from maasi_filter.ros.node_settings import NodeSettings
from maasi_filter.settings import EnvironmentSettings, Finite
from maasi_planner.buildings.settings import (
    BoxSettings,
    CuboidMethodSettings,
    CuboidSettings,
    DynamicsSettings,
    Face,
    HazardSettings,
    ObjectSettings,
)

Box = Annotated[list[Finite], Field(min_length=6, max_length=6)]


class CuboidPlannerSettings(NodeSettings):
    """Settings of the planner node of one robot."""

    live: ClassVar[frozenset[str]] = frozenset({'link_patience'})

    search_on_start: bool = Field(
        default=False,
        description='Whether the search starts as soon as the planner is active; otherwise with '
        'the service search/start',
    )
    step: float = Field(default=1.0, gt=0.0, le=10.0, description='dT, duration of a step [s]')
    environment: EnvironmentSettings = Field(description='Where robots may be')
    start: list[Finite] = Field(
        min_length=3, max_length=3, description='Where it starts, and recharges [m, map]'
    )
    yaw: Finite = Field(default=0.0, description='Heading at the start [rad]')
    dynamics: DynamicsSettings = Field(default_factory=DynamicsSettings, description='Its body')
    hazard: HazardSettings = Field(
        default_factory=HazardSettings, description='How its battery fails'
    )
    planner: CuboidMethodSettings = Field(
        default_factory=CuboidMethodSettings, description='The method'
    )
    objects: list[Box] = Field(
        min_length=1, description='To be searched: centre x y z and size x y z of each [m]'
    )
    faces: list[str] = Field(
        default=[], description='Faces of each object, with spaces between; none: the lateral ones'
    )
    obstacles: list[Box] = Field(
        default=[], description='To be kept away from: centre x y z and size x y z of each [m]'
    )
    link_patience: float = Field(
        default=0.3,
        gt=0.0,
        le=1.0,
        description='Share of a step after which it decides without having heard of anyone; '
        'not in lockstep [1]',
    )

    def search(self) -> CuboidSettings:
        """Return the search with its objects.

        Raises
        ------
        ValueError
            If the faces do not fit the objects.
        """
        if self.faces and len(self.faces) != len(self.objects):
            raise ValueError(
                f'faces: got {len(self.faces)}, allowed is one for each of {len(self.objects)} '
                'objects, or none'
            )
        content = self.planner.model_dump()
        objects = []
        for index, box in enumerate(self.objects):
            item: dict[str, object] = {'centre': box[:3], 'size': box[3:]}
            if self.faces:
                item['faces'] = self.faces[index].split()
            objects.append(item)
        content['objects'] = objects
        content['obstacles'] = [{'centre': box[:3], 'size': box[3:]} for box in self.obstacles]
        return CuboidSettings.model_validate(content)


def box_numbers(item: BoxSettings, floor: float) -> list[float]:
    """Return centre and size of a box as six numbers, on a floor at that height [m]."""
    corners = item.array(floor)
    return [*corners.mean(axis=1).tolist(), *item.size]


def face_words(item: ObjectSettings) -> str:
    """Return the faces of an object as a string."""
    faces: list[Face] = item.faces
    return ' '.join(faces)
