"""ROS 2 bags without ROS: what is in them becomes a log's raw streams, and a log's raw streams become readings."""
