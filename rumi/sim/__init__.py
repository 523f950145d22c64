"""Simulation in MuJoCo: scenes, the gripper, its sensors, the arm under torque control."""
