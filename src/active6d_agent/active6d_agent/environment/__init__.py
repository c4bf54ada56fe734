"""The paper's decision process as a Gymnasium environment, and its speed."""
