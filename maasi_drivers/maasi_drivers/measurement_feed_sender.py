"""Segments images on board of a robot and sends the blobs as a measurement feed."""

import argparse
import signal
import socket
import sys
import threading
import time

from pydantic import ValidationError

from maasi_drivers.settings.camera import SegmentationSettings
from maasi_drivers.vision.images import ImageSourceError, VideoSource
from maasi_drivers.vision.measurement_feed import MOST, FeedPacket, encode
from maasi_drivers.vision.segmentation import segment
from maasi_filter.wording import counted, problems

_ROUND = 0.002


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='measurement_feed_sender',
        description='Segment camera images and send the blobs to a driver with image_source: feed. '
        'It ends with the video, or by Ctrl-C.',
    )
    add = parser.add_argument
    sources = 'address (rtsp://...), device (/dev/video0) or file that OpenCV can open'
    add('video', metavar='VIDEO', help=sources)
    add('to', metavar='HOST:PORT', help='address of the driver')
    add('--rule', default='robust', help='segmentation rule: robust or paper (default: robust)')
    add(
        '--exposure-age',
        type=float,
        default=0.0,
        metavar='S',
        help='time from the middle of the exposure until OpenCV returns the image [s] (default: 0)',
    )
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the sender and return its exit code."""
    options = build_parser().parse_args(arguments)
    host, _, port = options.to.rpartition(':')
    try:
        if not host or not 0 < int(port) < 65536:
            raise ValueError
    except ValueError:
        print(f'error: read {options.to!r}, allowed is HOST:PORT', file=sys.stderr)
        return 2
    if not 0.0 <= options.exposure_age <= 1.0:
        print(
            f'error: --exposure-age: read {options.exposure_age}, allowed is 0 to 1 s',
            file=sys.stderr,
        )
        return 2
    try:
        settings = SegmentationSettings.model_validate({'rule': options.rule})
        source = VideoSource(options.video)
    except (ImageSourceError, ValidationError) as error:
        text = problems(error) if isinstance(error, ValidationError) else str(error)
        print(f'error: {text}', file=sys.stderr)
        return 2
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    sent, said = 0, ''
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as output:
        while not ended.wait(_ROUND):
            done = source.ended
            if source.error != said:
                said = source.error
                print(said or 'video: receiving frames', file=sys.stderr)
            frame = source.pop_frame()
            if frame is None:
                if done:
                    break
                continue
            blobs = segment(frame.image, settings)
            if len(blobs) > MOST:
                continue
            height, width = frame.image.shape[:2]
            age = time.monotonic() - frame.received + options.exposure_age
            packet = FeedPacket(frame.number, age, width, height, blobs)
            output.sendto(encode(packet), (host, int(port)))
            sent += 1
    source.close()
    print(f'{counted(sent, "image")} sent to {options.to}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
