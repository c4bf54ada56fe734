"""The node graph: in one process, as supervised processes, and one episode of it."""
