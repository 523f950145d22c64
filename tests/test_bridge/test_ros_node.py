"""The example of a node for ROS, against a stub of ROS."""

import json
import runpy
import socket
import sys
import time
from types import ModuleType, SimpleNamespace

import pytest

pytest.importorskip("msgspec")

from rumi.bridge.server import Served
from tests.fixtures.bridge import SCRIPTS, TOOL, WITHIN, Waver, serving
from tests.test_scripts.test_own_robot import code_lines


class Message(SimpleNamespace):
    """A message of ROS, as far as the node looks at it."""

    def __init__(self, **parts):
        super().__init__(**{"header": SimpleNamespace(), **parts})


class Node:
    def __init__(self, name):
        self.published, self.heard = {}, {}

    def create_publisher(self, kind, topic, depth):
        self.published[topic] = []
        return SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(self, kind, topic, call, depth):
        self.heard[topic] = call

    def get_logger(self):
        return SimpleNamespace(info=lambda text: self.published.setdefault("log", []).append(json.loads(text)))


def test_the_node_against_a_stub_of_ros(monkeypatch):
    poses = ("Point", "PointStamped", "Pose", "PoseStamped", "PoseWithCovariance", "PoseWithCovarianceStamped")
    stubs = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "nav_msgs.msg": {"Path": Message},
        "std_msgs.msg": {"Empty": Message, "Header": SimpleNamespace},
        "geometry_msgs.msg": dict.fromkeys((*poses, "Quaternion"), Message),
        "sensor_msgs.msg": {"PointCloud2": Message},
        "sensor_msgs_py.point_cloud2": {"read_points": lambda cloud, **asked: cloud},
    }
    for name, values in stubs.items():
        for at in range(1, name.count(".") + 2):
            part = ".".join(name.split(".")[:at])
            monkeypatch.setitem(sys.modules, part, sys.modules.get(part) or ModuleType(part))
        vars(sys.modules[name]).update(values)
    source = (SCRIPTS / "ros_bridge_node.py").read_text()
    assert len(code_lines(source, imports=True)) <= 60 and "import rumi" not in source
    node_of = runpy.run_path(str(SCRIPTS / "ros_bridge_node.py"))["Bridge"]

    def wait(topic, count):
        end = time.monotonic() + 30
        while len(node.published.get(topic, ())) < count and time.monotonic() < end:
            time.sleep(0.01)
        return node.published[topic][count - 1]

    def pose(*numbers):
        x, y, z, a, b, c, d = numbers
        return Message(pose=Message(position=Message(x=x, y=y, z=z), orientation=Message(x=a, y=b, z=c, w=d)))

    with serving(Served(Waver(), WITHIN), 1) as port:
        node = node_of(port=port)
        node.heard["tool_pose"](pose(*TOOL))
        node.heard["view"]([(0.5, 0.0, 0.1)])
        for step in range(2):
            path = wait("rumi/path", step + 1)
            assert path.header.frame_id == "world" and len(path.poses) == 20
            node.heard["contact"](Message(point=Message(x=0.5, y=0.0, z=0.06)))
            node.heard["tool_pose"](pose(*TOOL))
            node.heard["done"](Message())
        found = wait("rumi/pose", 3)
        assert found.pose.pose.orientation.w == 1 and len(found.pose.covariance) == 36
        assert wait("log", 2)["type"] == "end"
        node.socket.shutdown(socket.SHUT_RDWR)
