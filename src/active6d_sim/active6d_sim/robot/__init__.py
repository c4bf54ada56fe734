"""A simulated arm that carries the camera: kinematics, collisions and times of motion."""
