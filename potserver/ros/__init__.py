"""ROS 2 over Zenoh, without ROS: clouds and poses in, maps out, as rmw_zenoh and zenoh-bridge-ros2dds have them on the wire.

`bridge.Bridge` is a plain user of a map's public keys, so it runs in a server (`potserver serve --ros`) or anywhere else
(`potserver ros`).
"""
