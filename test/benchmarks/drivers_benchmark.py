"""Time of seeing: segmentation and projection of one image by the robust rule."""

from functools import partial

import cv2
from timing import entry, few, median_time

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.pose import Pose
from maasi_sim.simulation.camera import CameraRenderer
from maasi_sim.simulation.floor import RenderSettings, scene_of
from maasi_sim.simulation.world import TargetSettings, World

POSE = Pose.from_yaw([0.3, 0.3, 1.0], 0.4)


def renderer(settings):
    """Return the renderer of a moderately hard floor with a few markers."""
    world = World.from_settings(
        EnvironmentSettings(bounds=[[-0.3, 0.9], [-0.3, 0.9]]),
        TargetSettings(count=12, separation=0.12, margin=0.05),
        1,
    )
    distractors = {'sheets': 2, 'lines': 3, 'purple': 3, 'cyan': 3}
    floor = RenderSettings.model_validate({'distractors': distractors})
    camera = Camera.from_settings(settings)
    return CameraRenderer(camera, floor, scene_of(world, floor, 1), 1, 'drone')


def blob_detector(image):
    """Return OpenCV's detector of blobs, on the excess of blue, with the size of a marker left."""
    settings = cv2.SimpleBlobDetector_Params()
    settings.filterByArea, settings.minArea, settings.maxArea = True, 8.0, float(image[..., 0].size)
    settings.filterByColor, settings.blobColor = True, 255
    settings.filterByCircularity = settings.filterByConvexity = settings.filterByInertia = False
    detector = cv2.SimpleBlobDetector_create(settings)

    def detect():
        red, green, blue = cv2.split(image)
        return detector.detect(cv2.subtract(blue, cv2.max(red, green)))

    return detect


def run(share=1.0):
    for width, height, focal in ((160, 120, 220.0), (640, 480, 880.0)):
        shape = {'width': width, 'height': height, 'focal_length': [focal, focal]}
        times, drawn = [], None
        for rule in ('paper', 'robust'):
            values = {'distortion': [-0.1, 0.02, 0.001, -0.001], 'segmentation': {'rule': rule}}
            settings = CameraSettings.model_validate(shape | values)
            drawn = drawn or renderer(settings)
            image = drawn.render(POSE, 0, 0.0)
            detect = partial(MarkerDetector(settings).detect, image, POSE)
            times.append(1e3 * median_time(detect, few(share, 300)))
        what = "the paper's rule on the same image"
        yield entry(f'segment_{width}x{height}', times[1], 'ms', what, times[0] / times[1])
        ours, theirs = partial(MarkerDetector(settings).segment, image), blob_detector(image)
        value, other = (1e3 * median_time(call, few(share, 300)) for call in (ours, theirs))
        what = (
            f'OpenCV, SimpleBlobDetector, {other:.3g} ms: {len(theirs())} blobs, ours {len(ours())}'
        )
        yield entry(f'blobs_{width}x{height}', value, 'ms', what, other / value)
        render = partial(drawn.render, POSE, 1, 0.1, (0.3, 0.1, 0.0))
        yield entry(f'render_{width}x{height}', 1e3 * median_time(render, few(share, 300)))
