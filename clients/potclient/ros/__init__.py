"""ROS 2 messages without ROS: bytes to arrays and back, transforms at a stamp. Needs the extra `ros` (package rosbags).

Nothing here knows a network: what subscribes and publishes is `potserver.ros`, what reads bags is `potclient.datasets.bags`.
"""
