"""Reads the recording of a run with `rosbags` (pip install rosbags), without our packages.

python3 read_bag.py runs/<stamp>/bag
"""

import sys
from pathlib import Path

from rosbags.highlevel import AnyReader

found, ways = {}, {}
# The definitions of all messages are in the recording.
with AnyReader([Path(sys.argv[1])]) as reader:
    for connection, _, data in reader.messages():
        if connection.topic.endswith('/state'):
            state = reader.deserialize(data, connection.msgtype)
            stamp, place = state.header.stamp, state.pose.pose.position
            time = stamp.sec + 1e-9 * stamp.nanosec
            ways.setdefault(connection.topic, []).append((time, place.x, place.y, place.z))
        elif connection.topic.endswith('found_targets'):
            message = reader.deserialize(data, connection.msgtype)
            found |= {item.id: item for item in message.targets}
for topic, way in ways.items():
    print(f'{topic}: {len(way)} poses, from {way[0][0]:.1f} to {way[-1][0]:.1f} s')
for number, item in sorted(found.items()):
    place = item.position
    print(f'target {number} at ({place.x:.2f}, {place.y:.2f}, {place.z:.2f}) m by {item.robot}')
