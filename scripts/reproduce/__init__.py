"""The paper's experiments on this simulator: runs that are done once, and the tables and figures over them."""
