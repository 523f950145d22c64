"""Push models: what a motion of the robot does to itself and to the object."""
