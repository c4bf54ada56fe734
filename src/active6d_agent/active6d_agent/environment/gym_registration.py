"""Makes ``gymnasium.make("Active6D-v0", bank=...)`` and ``gymnasium.make_vec`` work."""

ENVIRONMENT_ID = "Active6D-v0"


def register_environment() -> bool:
    """Register the environment once; whether Gymnasium is installed. Its classes are imported when one is made."""
    try:
        from gymnasium.envs.registration import register, registry
    except ImportError:
        return False
    if ENVIRONMENT_ID not in registry:
        module = "active6d_agent.environment.gym_environment"
        register(ENVIRONMENT_ID, entry_point=f"{module}:Active6DEnv", vector_entry_point=f"{module}:Active6DVectorEnv")
    return True
