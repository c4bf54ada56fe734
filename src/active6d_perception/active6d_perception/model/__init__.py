"""What a camera sees of an object model, and distances between its poses."""
