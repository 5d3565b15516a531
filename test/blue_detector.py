"""A detector as others write them, and its messages: boxes around what is blue in an image."""

import cv2
import numpy as np
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2D, Detection2DArray, ObjectHypothesisWithPose

from maasi_drivers.vision.images import image_to_array
from maasi_filter.ros.qos import RELIABLE


def box(centre, size, label=('person', 0.75), theta=0.0):
    made = Detection2D(id='17')
    made.bbox.center.position.x, made.bbox.center.position.y = map(float, centre)
    made.bbox.size_x, made.bbox.size_y = map(float, size)
    made.bbox.center.theta = theta
    # The least likely class first.
    for class_id, score in [('dog', 0.1), label] if label else []:
        made.results.append(ObjectHypothesisWithPose())
        made.results[-1].hypothesis.class_id, made.results[-1].hypothesis.score = class_id, score
    return made


class BlueDetector:
    """What a detector does in a node, in the namespace of its robot; it sees a dog as well."""

    def __init__(self, node, space=''):
        self.publisher = node.create_publisher(
            Detection2DArray, f'{space}camera/detections', RELIABLE
        )
        node.create_subscription(Image, f'{space}camera/image_raw', self.on_image, RELIABLE)
        self.frame = None  # in place of that of the image

    def on_image(self, message):
        red, green, blue = np.moveaxis(image_to_array(message).astype(int), 2, 0)
        mask = (blue - (red + green) // 2 > 60).astype(np.uint8)
        _, _, parts, _ = cv2.connectedComponentsWithStats(mask)
        found = Detection2DArray(header=message.header)
        found.detections = [box((x + w / 2, y + h / 2), (w, h)) for x, y, w, h, _ in parts[1:]]
        found.detections.append(box((80, 60), (9, 9), ('dog', 0.9)))
        if self.frame is not None:
            found.header.frame_id = self.frame
        self.publisher.publish(found)
