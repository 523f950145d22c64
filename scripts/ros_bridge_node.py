"""A ROS 2 node between an arm and `rumi serve`; it needs rclpy and nothing of rumi.

    rumi serve --mesh part.stl --workspace 0.2 -0.3 0.06 0.85 0.3 0.06 --action-m 0.05
    python scripts/ros_bridge_node.py --ros-args -r tool_pose:=/arm/tool_pose

Takes tool_pose (PoseStamped), contact (PointStamped: a point that was felt), view (PointCloud2 in the world's frame:
what a camera sees of the object, and a run begins) and done (Empty: the path has been gone). Gives rumi/path (Path:
where the tool is to go next) and rumi/pose (PoseWithCovarianceStamped: where the object is).
"""

import json
import socket
import threading

import rclpy
from geometry_msgs import msg as geometry
from nav_msgs.msg import Path
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from sensor_msgs_py.point_cloud2 import read_points
from std_msgs.msg import Empty, Header

WORLD = Header(frame_id="world")


class Bridge(Node):
    def __init__(self, host="127.0.0.1", port=7711):
        super().__init__("rumi_bridge")
        self.socket = socket.create_connection((host, port))
        self.tool, self.felt, self.moving = None, [], False
        self.path = self.create_publisher(Path, "rumi/path", 1)
        self.pose = self.create_publisher(geometry.PoseWithCovarianceStamped, "rumi/pose", 1)
        self.create_subscription(geometry.PoseStamped, "tool_pose", self.on_tool, 100)
        self.create_subscription(geometry.PointStamped, "contact", self.on_contact, 100)
        self.create_subscription(PointCloud2, "view", self.on_view, 1)
        self.create_subscription(Empty, "done", self.on_done, 1)
        threading.Thread(target=self.listen, daemon=True).start()

    def tell(self, **message):
        self.socket.sendall(json.dumps(message).encode() + b"\n")

    def on_tool(self, message):
        at, turn = message.pose.position, message.pose.orientation
        self.tool = [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
        if self.moving:
            felt, self.felt = self.felt, []
            self.tell(type="sample", tool=self.tool, touched=felt)

    def on_contact(self, message):
        self.felt.append([message.point.x, message.point.y, message.point.z])

    def on_view(self, message):
        points = read_points(message, field_names=("x", "y", "z"), skip_nans=True)
        self.tell(type="start", tool=self.tool, surface=[[float(value) for value in point] for point in points])

    def on_done(self, message):
        self.moving = False
        self.tell(type="done")

    def listen(self):
        for told in map(json.loads, self.socket.makefile()):
            if told["type"] == "action":
                poses = [geometry.PoseStamped(header=WORLD, pose=pose_of(numbers)) for numbers in told["path"]]
                self.felt, self.moving = [], True
                self.path.publish(Path(header=WORLD, poses=poses))
            elif told["type"] == "belief":
                pose = pose_of(told["pose"]["position_m"] + told["pose"]["quaternion_xyzw"])
                covariance = [value for row in told["pose"]["covariance"] for value in row]
                found = geometry.PoseWithCovariance(pose=pose, covariance=covariance)
                self.pose.publish(geometry.PoseWithCovarianceStamped(header=WORLD, pose=found))
            else:
                self.get_logger().info(json.dumps(told))


def pose_of(numbers):
    """A pose of x y z and a quaternion x y z w."""
    place = geometry.Point(**dict(zip("xyz", numbers[:3], strict=True)))
    return geometry.Pose(position=place, orientation=geometry.Quaternion(**dict(zip("xyzw", numbers[3:], strict=True))))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Bridge())
