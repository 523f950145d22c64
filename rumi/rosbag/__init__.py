"""ROS 2 bags without ROS: import as a log of raw streams, and readings made of these."""
