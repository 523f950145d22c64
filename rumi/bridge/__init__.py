"""Bridge: a robot in another process, by messages over a socket."""
