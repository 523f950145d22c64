"""Push models: predicted motion of the robot and of the object that it pushes."""
