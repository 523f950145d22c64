"""What readings say about space and about a pose."""
