"""Where to look next: object attention, policies and baselines, and what trains and evaluates them."""
