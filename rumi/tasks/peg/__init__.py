"""Find a block on a table by touch and put a peg into it, in a simulated cell (the time-allocation paper's task)."""
