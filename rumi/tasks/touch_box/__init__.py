"""Finding a box by touch alone and grasping it: the task, its robots, pokes, their choice, and the loop."""
