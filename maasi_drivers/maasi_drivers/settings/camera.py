"""Settings of a robot's camera: intrinsics, mount, noise and marker segmentation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import AfterValidator, Field, ValidationError, model_validator

from maasi_filter.plugins import OwnSettings, PluginGroup
from maasi_filter.settings import Finite, Settings, Vector3
from maasi_filter.wording import problems

# Plausible ranges of a camera.
Focal = Annotated[Finite, Field(gt=0.0, le=1e6)]
Pixel = Annotated[Finite, Field(ge=-1e6, le=1e6)]
Coefficient = Annotated[Finite, Field(ge=-1e4, le=1e4)]

DistortionModel = Literal['plumb_bob', 'rational_polynomial', 'equidistant']
# Allowed numbers of coefficients of each model; none is allowed as well.
COEFFICIENTS = {'plumb_bob': (4, 5), 'rational_polynomial': (8, 12, 14), 'equidistant': (4,)}

DETECTORS = PluginGroup(
    'maasi.detectors',
    'segmentation rule',
    'maasi_drivers.vision.detector:Detector',
    {
        'robust': 'maasi_drivers.vision.segmentation:segment_robust',
        'paper': 'maasi_drivers.vision.segmentation:segment_paper',
        'aruco': 'maasi_drivers.vision.segmentation:segment_fiducials',
    },
)
_DETECTOR = OwnSettings(DETECTORS, 'rule')


class SegmentationSettings(Settings):
    """How marker pixels are separated from the floor; see `maasi_drivers.vision.segmentation`."""

    rule: Annotated[str, DETECTORS, AfterValidator(DETECTORS.check)] = Field(
        'robust',
        description="'paper': fixed blue excess (real-drone exploration 2024, eq. 16), blobs of "
        "at least minimum_area; 'robust': adapts to light and checks size and shape; 'aruco': "
        'fiducial markers, whose ids identify targets; or your own module:Class',
    )
    settings: Annotated[Any, _DETECTOR, AfterValidator(_DETECTOR.check)] = Field(
        None, validate_default=True, description='Settings of your own detector'
    )
    dictionary: Literal[
        '4X4_50', '4X4_250', '5X5_50', '5X5_250', '6X6_50', '6X6_250', 'APRILTAG_36h11'
    ] = Field('4X4_50', description='Aruco rule: dictionary of the markers')
    threshold: float = Field(
        35.0,
        ge=0,
        le=255,
        description='Paper rule: smallest blue excess of a marker pixel [grey levels]',
    )
    minimum_area: float = Field(
        2e-4,
        ge=0,
        lt=1,
        description="Paper rule: smallest blob, as a share of the image's pixels; default: 4 px of "
        '160 x 120; 0: single pixels [-]',
    )
    saturation: float = Field(
        0.40,
        gt=0,
        le=3,
        description='Robust rule: least blueness (B - max(R, G)) / mean of a marker pixel, after '
        'white balance [-]',
    )
    peak_saturation: float = Field(
        0.70, gt=0, le=3, description='Robust rule: least peak blueness of a marker [-]'
    )
    noise_factor: float = Field(
        7.0, gt=0, description="Robust rule: threshold in deviations (MAD) of the floor's blueness"
    )
    maximum_aspect: float = Field(
        2.5, ge=1, description='Robust rule: largest ratio of length to width of a blob [-]'
    )
    minimum_solidity: float = Field(
        0.80,
        gt=0,
        le=1,
        description='Robust rule: smallest ratio of area to that of its ellipse [-]',
    )
    minimum_diameter: float = Field(
        0.55,
        gt=0,
        description='Robust rule: smallest diameter on the floor, in marker diameters [-]',
    )
    maximum_diameter: float = Field(
        1.6, gt=0, description='Robust rule: largest diameter on the floor, in marker diameters [-]'
    )

    @model_validator(mode='after')
    def _ordered(self) -> SegmentationSettings:
        if self.peak_saturation < self.saturation:
            raise ValueError(
                f'peak_saturation: got {self.peak_saturation}, '
                f'allowed at least saturation ({self.saturation})'
            )
        if self.maximum_diameter <= self.minimum_diameter:
            raise ValueError(
                f'maximum_diameter: got {self.maximum_diameter}, '
                f'allowed more than minimum_diameter ({self.minimum_diameter})'
            )
        return self


class MountSettings(Settings):
    """Pose of the camera on the robot (REP-103); without rpy it looks forward, image top up."""

    position: Vector3 = Field(
        [0.0, 0.0, 0.0], description="Optical centre in the robot's frame [m]"
    )
    rpy: Vector3 = Field(
        [0.0, 1.5707963267948966, 0.0],
        description='Roll, pitch, yaw of the camera about fixed axes of the robot [rad]',
    )


class BoxSettings(Settings):
    """How to use the boxes that a detector of another package publishes.

    Boxes of one object that overlap by three quarters, as two people draw them, differ by 7 to
    14 % of their size, therefore the default of `error`.
    """

    classes: list[str] = Field([], description='Classes (class_id) of targets; default: all')
    point: Literal['foot', 'centre'] = Field(
        'foot',
        description="Point of a box on the floor: 'foot' (middle of the lower side, for standing "
        "objects seen from the side) or 'centre' (for flat objects or views from above)",
    )
    error: float = Field(
        0.1,
        gt=0.0,
        le=0.5,
        description='Deviation of that point, as a share of the width and height of its box; 0.5 '
        'for boxes that the border cuts [1]',
    )


class CameraSettings(Settings):
    """A camera that sees the floor.

    The defaults suit a drone at 1 m: 160 x 120 px, looking down. A focal length of 260 px
    covers the papers' field of view of +-0.2 m with markers of 3 cm; at the nominal 300 px
    markers at its edge are cut.
    """

    width: int = Field(160, ge=8, le=16384, description='Image width [px]')
    height: int = Field(120, ge=8, le=16384, description='Image height [px]')
    focal_length: list[Focal] = Field(
        [260.0, 260.0],
        min_length=2,
        max_length=2,
        description='Focal length along image x and y (beta_x, beta_y in eq. 18 of real-drone '
        'exploration 2024) [px]',
    )
    principal_point: list[Pixel] | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="Optical centre; pixel centres are integers; default: the image's centre [px]",
    )
    distortion: list[Coefficient] = Field(
        default_factory=list,
        description='Coefficients of the distortion model, in the order of OpenCV; default: none '
        '[-]',
    )
    distortion_model: DistortionModel = Field(
        'plumb_bob',
        description="'plumb_bob': k1, k2, p1, p2[, k3]; 'rational_polynomial': k1, k2, p1, p2, k3, "
        "k4, k5, k6[, of thin prism and tilt: 4 or 6]; 'equidistant' (fisheye): k1, k2, k3, k4",
    )
    mount: MountSettings = Field(
        default_factory=MountSettings, description='Pose of the camera on the robot'
    )
    rate: float = Field(10.0, gt=0, description='Images per second [Hz]')
    stamp_offset: float = Field(0.0, description='Added to image stamps: minus their latency [s]')
    marker_diameter: float = Field(0.03, gt=0, description='Diameter of the markers [m]')
    pixel_noise: float = Field(
        0.1,
        gt=0,
        description='Deviation of a centroid in addition to image noise; about 0.03 for raw '
        'images and the robust rule, 0.1 for JPEG or the paper rule [px]',
    )
    position_noise: float = Field(
        0.0, ge=0, description="Deviation of the pose's coordinates if its message has none [m]"
    )
    orientation_noise: float = Field(
        0.0, ge=0, description="Deviation of the pose's angles if its message has none [rad]"
    )
    cut_blobs: Literal['keep', 'drop'] = Field(
        'keep',
        description='Blobs cut by the image border: keep with a larger covariance, or drop',
    )
    segmentation: SegmentationSettings = Field(
        default_factory=SegmentationSettings, description='Segmentation of markers'
    )
    detections: BoxSettings | None = Field(
        None,
        description='Use of camera/detections (vision_msgs/Detection2DArray) instead of images; '
        'default: the driver detects markers in images',
    )

    @model_validator(mode='after')
    def _consistent(self) -> CameraSettings:
        allowed = COEFFICIENTS[self.distortion_model]
        if len(self.distortion) not in (0, *allowed):
            raise ValueError(
                f'distortion: got {len(self.distortion)} coefficients, allowed with '
                f'{self.distortion_model} are {", ".join(map(str, (0, *allowed)))}'
            )
        return self

    @property
    def least_coefficients(self) -> int:
        """Smallest number of coefficients without distortion."""
        return {'plumb_bob': 5}.get(self.distortion_model, COEFFICIENTS[self.distortion_model][0])

    def with_camera_info(self, info: Any) -> CameraSettings:
        """Return these settings with the intrinsics of a ``sensor_msgs/CameraInfo``.

        The calibration is for the full image; images may show a region of interest with
        binned pixels.
        """
        k, roi, size = [float(value) for value in info.k], info.roi, []
        for axis, whole, start, length, bins in (
            (0, info.width, roi.x_offset, roi.width, info.binning_x),
            (1, info.height, roi.y_offset, roi.height, info.binning_y),
        ):
            shown, count = int(length or whole - start), max(int(bins), 1)
            if start + shown > whole:
                raise ValueError(
                    f'roi: got pixels {start} to {start + shown} along {"xy"[axis]}, allowed are '
                    f'0 to {whole}'
                )
            k[4 * axis] /= count
            # Pixel centres are integers: that of a binned pixel is the middle of its bin.
            k[2 + 3 * axis] = (k[2 + 3 * axis] - start + 0.5) / count - 0.5
            size.append(shown // count)
        return self.with_calibration(size[0], size[1], k, list(info.d), str(info.distortion_model))

    def with_calibration(
        self,
        width: int,
        height: int,
        k: list[float],
        d: list[float],
        distortion_model: str = 'plumb_bob',
    ) -> CameraSettings:
        """Return these settings with other intrinsics [px], of the images themselves."""
        model = distortion_model or 'plumb_bob'
        if model not in COEFFICIENTS:
            allowed = ' or '.join(COEFFICIENTS)
            raise ValueError(f"distortion_model: got '{distortion_model}', allowed {allowed}")
        if len(k) != 9:
            raise ValueError(f'k: got {len(k)} numbers, allowed 9')
        matrix = [float(value) for value in k]
        if any(matrix[i] != 0 for i in (1, 3, 6, 7)) or matrix[8] != 1:
            raise ValueError(f'k: got {matrix}, allowed [fx, 0, cx, 0, fy, cy, 0, 0, 1]')
        given = {
            'width': width,
            'height': height,
            'focal_length': [matrix[0], matrix[4]],
            'principal_point': [matrix[2], matrix[5]],
            # Some cameras fill unused coefficients with zeros.
            'distortion': [float(value) for value in d] if any(d) else [],
            'distortion_model': model,
        }
        try:
            return CameraSettings.model_validate(self.model_dump() | given)
        except ValidationError as error:
            raise ValueError(problems(error)) from None


def load_calibration(path: str | Path, settings: CameraSettings) -> CameraSettings:
    """Return settings with the intrinsics of a ROS ``camera_calibration`` file."""
    try:
        content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
        return settings.with_calibration(
            int(content['image_width']),
            int(content['image_height']),
            list(content['camera_matrix']['data']),
            list(content['distortion_coefficients']['data']),
            str(content.get('distortion_model', 'plumb_bob')),
        )
    except KeyError as error:
        raise ValueError(f'{path}: key {error} is missing') from error
    except (TypeError, AttributeError, yaml.YAMLError) as error:
        raise ValueError(f'{path}: not a calibration file ({error})') from error
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error
