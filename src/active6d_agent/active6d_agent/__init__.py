"""View planning: policies, the environment that they are trained in, and their evaluation.

Importing this package registers the environment ``Active6D-v0`` where Gymnasium is installed.
"""

from active6d_agent.environment.gym_registration import register_environment

register_environment()
