"""MuJoCo scenes, the gripper in them, what its sensors report, and the tasks by name."""
