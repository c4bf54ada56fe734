"""The paper's policy: object attention and a Gaussian over view directions, trained with PPO."""
